"""Pages and HTTP interface over a store; needs the extra `web`, and is imported by nobody but the command line."""
