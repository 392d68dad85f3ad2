"""Who may do what over HTTP: settings, users with passwords, sessions, names of hosts; it knows nothing of requests."""

from servoscope.service.access.allowed_hosts import AllowedHosts, is_loopback
from servoscope.service.access.sessions import LoginThrottle, Session, Sessions
from servoscope.service.access.settings import WebSettings
from servoscope.service.access.users import ROLES, Role, Users, is_permitted

__all__ = [
    "ROLES",
    "AllowedHosts",
    "LoginThrottle",
    "Role",
    "Session",
    "Sessions",
    "Users",
    "WebSettings",
    "is_loopback",
    "is_permitted",
]
