"""One file per kind of evidence: how it is learned from healthy recordings, and what it says of another one."""
