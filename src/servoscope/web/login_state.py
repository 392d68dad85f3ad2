"""What a browser keeps while its user logs in at a provider: signed, so that the server itself keeps nothing."""

from __future__ import annotations

import hashlib
import hmac
import json
import secrets
from base64 import urlsafe_b64decode, urlsafe_b64encode
from dataclasses import asdict, dataclass

LASTS_S = 600.0  # that a user may take at the provider


@dataclass(frozen=True)
class LoginState:
    """One login under way."""

    state: str  # what the provider has to return: the answer belongs to this browser
    nonce: str  # what the ID token has to hold: it was made for this login
    verifier: str  # PKCE (RFC 7636): the code is of no use to others
    target: str  # page to go on to
    expires: float  # by the monotonic clock of the server [s]


class LoginStates:
    """Makes and reads the text of a cookie; with a key of its own, so that a restart ends what is under way."""

    def __init__(self) -> None:
        self._key = secrets.token_bytes(32)

    def begin(self, target: str, now: float) -> tuple[LoginState, str]:
        """Return a new state, and the text that the browser keeps."""
        state, nonce, verifier = (secrets.token_urlsafe(32) for _ in range(3))
        made = LoginState(state, nonce, verifier, target, now + LASTS_S)
        body = urlsafe_b64encode(json.dumps(asdict(made)).encode()).decode()
        return made, f"{body}.{self._sign(body)}"

    def read(self, text: str, now: float) -> LoginState | None:
        """Return the state of a text that was made here and is still good, else None."""
        body, _, signature = text.partition(".")
        if not hmac.compare_digest(signature.encode(), self._sign(body).encode()):
            return None
        login_state = LoginState(**json.loads(urlsafe_b64decode(body)))
        return login_state if now < login_state.expires else None

    def _sign(self, body: str) -> str:
        return hmac.new(self._key, body.encode(), hashlib.sha256).hexdigest()
