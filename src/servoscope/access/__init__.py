"""Who may do what over HTTP: settings, users with passwords, sessions, names of hosts; it knows nothing of requests."""

from servoscope.access.hosts import Hosts, is_loopback
from servoscope.access.sessions import Attempts, Session, Sessions
from servoscope.access.settings import WebSettings
from servoscope.access.users import ROLES, Role, Users, may

__all__ = [
    "ROLES",
    "Attempts",
    "Hosts",
    "Role",
    "Session",
    "Sessions",
    "Users",
    "WebSettings",
    "is_loopback",
    "may",
]
