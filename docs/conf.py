"""How Sphinx makes the site of these pages: python -m sphinx -W docs SITE.

It needs no network, and gives the same bytes each time.
"""

import re

from docutils import nodes

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


# what a page that treats a word is found by as well
SYNONYMS = {
    "backlash": "play clearance lash",
    "friction": "stiction stick-slip lubrication",
    "fault": "failure defect anomaly malfunction",
    "baseline": "reference training train model fingerprint",
    "learn": "train training fit teach",
    "relearn": "retrain update recalibrate",
    "diagnose": "analyse analyze detect predict classify",
    "alarm": "alert notification warning event",
    "threshold": "limit cutoff sensitivity",
    "false alarm": "positive specificity",
    "csv": "spreadsheet table export text",
    "excel": "spreadsheet xls workbook",
    "recording": "log trace dataset measurement capture",
    "columns": "channels signals tags mapping headers",
    "reference": "setpoint command target demand",
    "output": "actual feedback measured position",
    "torque": "current effort force",
    "resample": "interpolate jitter irregular",
    "covariate": "temperature ambient condition",
    "remaining": "rul prognosis lifetime degradation wear",
    "trend": "rul prognosis lifetime degradation drift",
    "mail": "email smtp",
    "login": "password authentication sso authorization",
    "user": "account role permission",
    "service": "daemon server systemd docker container deploy",
    "dashboard": "gui browser ui hmi",
    "install": "setup pip installation requirements",
    "notebook": "jupyter",
    "python": "api library import",
    "drive": "plc controller firmware embedded",
    "motor axis": "servo linear rotary cnc",
    "cylinder": "hydraulics press actuator",
    "robot": "manipulator joint urdf",
    "delay": "latency lag deadtime",
    "units": "si scaling conversion",
    "before deployment": "planning feasibility simulation",
}
MIN_MENTIONS = 8  # from which a page treats a word that neither its name nor a heading has


def add_synonyms(app, doctree):
    """Let a page be found by synonyms of the words that it treats."""
    titles = [title.astext() for title in doctree.findall(nodes.title)]
    headings = " ".join([app.env.current_document.docname, *titles]).casefold()
    text = doctree.astext().casefold()
    treated = (word for word in SYNONYMS if word in headings or text.count(word) >= MIN_MENTIONS)
    words = sorted({synonym for word in treated for synonym in SYNONYMS[word].split()})
    if words:
        doctree.insert(0, nodes.meta("", name="keywords", content=", ".join(words)))


def setup(app):
    """Tell Sphinx what to call when it has read a page."""
    app.connect("doctree-read", add_synonyms)
    app.connect("source-read", add_navigation)
    return {"parallel_read_safe": True}
