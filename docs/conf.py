"""How Sphinx makes the site of these pages: python -m sphinx -W docs SITE.

It needs no network, and gives the same bytes each time.
"""

import re

project = "servoscope"
project_copyright = "The servoscope developers"
extensions = ["myst_parser"]
myst_heading_anchors = 4  # links to headings work as on a git host
html_theme = "furo"
html_title = "servoscope"
html_copy_source = False
html_show_sphinx = False
html_show_copyright = False

LINK = re.compile(r"^- \[(?P<title>[^]]+)\]\((?P<page>[^)]+)\.md\)", re.M)


def add_navigation(app, name, source):
    """Make each list of pages in index.md a part of the navigation, under its heading."""
    if name != "index":
        return
    for heading, text in re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", source[0], re.M | re.S):
        pages = "".join(f"{link['title']} <{link['page']}>\n" for link in LINK.finditer(text))
        source[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {heading}\n\n{pages}```\n"


def setup(app):
    """Tell Sphinx what to call when it has read a page."""
    app.connect("source-read", add_navigation)
    return {"parallel_read_safe": True}
