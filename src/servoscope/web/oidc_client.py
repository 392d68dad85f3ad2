"""The client of an OpenID Connect provider (Core 3.1): authorization code with PKCE, and the ID token checked."""

from __future__ import annotations

import asyncio
import time
import warnings
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

import httpx

from servoscope.core.addresses import hide_secrets, show_address
from servoscope.core.errors import ConfigError, ServoscopeError
from servoscope.service.access.oidc import OidcSettings

# it prefers a successor of httpx, and sets filters of its own for saying so
with warnings.catch_warnings(record=True):
    try:
        from authlib.common.errors import AuthlibBaseError
        from authlib.integrations.httpx_client import AsyncOAuth2Client, OAuthError
        from authlib.oidc.core import CodeIDToken
        from joserfc import jwt
        from joserfc.errors import InvalidKeyIdError, JoseError
        from joserfc.jwk import KeySet
    except ModuleNotFoundError as error:
        raise ConfigError(f"{str(error.name).partition('.')[0]} is missing, pip install 'servoscope[oidc]'") from None

# "none" proves nothing, and with HMAC whoever knows the client's secret could write tokens
ALGORITHMS = ("RS256", "RS384", "RS512", "PS256", "PS384", "PS512", "ES256", "ES384", "ES512", "EdDSA", "Ed25519")
LEEWAY_S = 60.0  # by which clocks may differ
METADATA_S = 3600.0  # after which addresses and keys are asked for again
RETRY_S = 5.0  # after which a provider that did not answer is asked again
KEYS_S = 60.0  # least time between two looks for a key that is unknown
ENDPOINTS = ("authorization_endpoint", "token_endpoint", "jwks_uri")


class ProviderError(ServoscopeError):
    """The provider does not answer as it should; the text says why, without secrets."""


class OidcClient:
    """Talks to one provider; its addresses and keys are kept for a while."""

    def __init__(self, settings: OidcSettings, secret: str | None) -> None:
        self._settings, self._secret = settings, secret
        self._metadata: dict[str, Any] = {}
        self._keys: KeySet | None = None
        self._metadata_until = self._keys_after = self._failed_until = 0.0  # by the monotonic clock
        self._failure = ""  # of the last look for the metadata
        self._loading = asyncio.Lock()

    async def authorization_url(self, state: str, nonce: str, verifier: str) -> str:
        """Return where a browser is sent to log in; raises ProviderError."""
        metadata = await self._load_metadata()
        async with self._session() as session:
            url, _ = session.create_authorization_url(
                metadata["authorization_endpoint"], state=state, nonce=nonce, code_verifier=verifier
            )
        return str(url)

    async def redeem(self, code: str, nonce: str, verifier: str) -> Mapping[str, Any]:
        """Return the claims of the ID token that a code is good for; raises ProviderError."""
        metadata = await self._load_metadata()
        try:
            async with self._session() as session:
                token = await session.fetch_token(metadata["token_endpoint"], code=code, code_verifier=verifier)
            claims = await self._check(dict(token), nonce)
            if self._settings.user_name(claims) is None or self._settings.role(claims) is None:
                claims = {**await self._load_userinfo(token, claims["sub"]), **claims}
            return claims
        except (httpx.HTTPError, httpx.InvalidURL, AuthlibBaseError, JoseError) as error:
            raise self._problem(error) from None
        except (ValueError, KeyError, TypeError, AttributeError) as error:  # of answers that are no tokens
            raise self._problem(error) from None

    async def _check(self, token: Mapping[str, Any], nonce: str) -> Mapping[str, Any]:
        """Return the claims of an ID token whose signature, issuer, audience, times and nonce are right."""
        text = token["id_token"]
        try:
            decoded = jwt.decode(text, await self._load_keys(), algorithms=list(ALGORITHMS))
        except InvalidKeyIdError:  # the provider has new keys
            decoded = jwt.decode(text, await self._load_keys(renew=True), algorithms=list(ALGORITHMS))
        expected = {
            "iss": {"essential": True, "value": self._settings.issuer},
            "aud": {"essential": True, "value": self._settings.client_id},
        }
        params = {"nonce": nonce, "client_id": self._settings.client_id, "access_token": token.get("access_token")}
        claims = CodeIDToken(decoded.claims, decoded.header, expected, params)
        claims.validate(leeway=LEEWAY_S)
        return dict(claims)

    async def _load_userinfo(self, token: Mapping[str, Any], subject: str) -> dict[str, Any]:
        """Return what the provider tells of a user beside the ID token (Core 5.3); nothing if it tells no more."""
        url = (await self._load_metadata()).get("userinfo_endpoint")
        if url is None:
            return {}
        claims = await self._get(url, {"Authorization": f"Bearer {token['access_token']}"})
        if claims.get("sub") != subject:  # else the token of one user could bring the groups of another
            raise self._problem(ValueError("its userinfo is of another user than its ID token"))
        return claims

    async def _load_metadata(self) -> dict[str, Any]:
        async with self._loading:  # nobody has logged in yet: many who ask must not become many requests to a provider
            now = time.monotonic()
            if not self._metadata or now >= self._metadata_until:
                if now < self._failed_until:
                    raise ProviderError(self._failure)
                try:
                    self._metadata, self._keys = await self._fetch_metadata(), None
                except ProviderError as error:
                    self._failure, self._failed_until = str(error), time.monotonic() + RETRY_S
                    raise
                self._metadata_until = time.monotonic() + METADATA_S
            return self._metadata

    async def _fetch_metadata(self) -> dict[str, Any]:
        metadata = await self._get(self._settings.issuer.rstrip("/") + "/.well-known/openid-configuration")
        if metadata.get("issuer") != self._settings.issuer:
            raise self._problem(ValueError("it names itself otherwise: issuer must be written as it does"))
        secure = urlsplit(self._settings.issuer).scheme
        for name in (*ENDPOINTS, *({"userinfo_endpoint"} & metadata.keys())):
            if not str(metadata.get(name, "")).startswith(("https://", f"{secure}://")):
                raise self._problem(ValueError(f"its {name} is missing, or not https"))
        return metadata

    async def _load_keys(self, *, renew: bool = False) -> KeySet:
        if self._keys is None or (renew and time.monotonic() >= self._keys_after):
            self._keys_after = time.monotonic() + KEYS_S
            plain: Any = await self._get((await self._load_metadata())["jwks_uri"])
            self._keys = KeySet.import_key_set(plain)
        return self._keys

    async def _get(self, url: str, headers: Mapping[str, str] | None = None) -> dict[str, Any]:
        try:
            async with httpx.AsyncClient(timeout=self._settings.timeout_s) as client:
                answer = await client.get(url, headers=headers)
                document = answer.raise_for_status().json()
        except (httpx.HTTPError, httpx.InvalidURL, ValueError) as error:
            raise self._problem(error) from None
        if not isinstance(document, dict):
            raise self._problem(ValueError("its answer is no table"))
        return document

    def _session(self) -> Any:
        public = self._secret is None
        return AsyncOAuth2Client(
            client_id=self._settings.client_id,
            client_secret=self._secret,
            token_endpoint_auth_method="none" if public else "client_secret_basic",
            scope=" ".join(self._settings.scopes),
            redirect_uri=self._settings.callback,
            code_challenge_method="S256",
            timeout=self._settings.timeout_s,
        )

    def _problem(self, error: Exception) -> ProviderError:
        # what a provider writes behind its error may repeat what it was sent: code, secret, verifier
        text = str(error.error) if isinstance(error, OAuthError) else str(error)
        reason = " ".join(hide_secrets(text).split())[:200] or type(error).__name__
        return ProviderError(f"{show_address(self._settings.issuer)}: {reason}")
