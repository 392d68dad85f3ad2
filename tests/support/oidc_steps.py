"""What a browser does to log in at a provider, step by step."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any

import httpx
from oidc_provider import ADDRESS

from servoscope.web.app import create_app
from servoscope.web.dependencies import Context


def browse(context: Context, steps: Callable[[httpx.AsyncClient], Awaitable[Any]]) -> Any:
    async def browsing() -> Any:
        transport = httpx.ASGITransport(create_app(context), client=("192.0.2.1", 1))
        async with httpx.AsyncClient(transport=transport, base_url=ADDRESS) as browser:
            return await steps(browser)

    return asyncio.run(browsing())


async def go_to_provider(browser: httpx.AsyncClient, target: str = "/alarms") -> str:
    answer = await browser.get("/api/v1/session/oidc", params={"next": target})
    assert answer.status_code == 303
    return answer.headers["location"]


async def confirm(url: str, sub: str = "7", **form: str) -> str:
    """Log in at the provider; return where it leads to."""
    async with httpx.AsyncClient() as client:
        return (await client.post(url, data={"sub": sub, **form})).headers["location"]


async def confirm_by_forms(url: str, sub: str) -> str:
    """Log in at a provider that asks for a name, then for consent; return where it leads to."""
    async with httpx.AsyncClient() as client:
        answer = await client.get(url)
        for form in ({"prompt": "login", "login": sub, "password": "any"}, {"prompt": "consent"}, {}):
            while answer.is_redirect:
                if answer.headers["location"].startswith(ADDRESS):
                    return str(answer.headers["location"])
                answer = await client.get(answer.next_request.url)  # type: ignore[union-attr]
            answer = await client.post(answer.url, data=form)
    raise AssertionError(f"the provider answers {answer.status_code}: {answer.text[:500]}")


async def log_in(browser: httpx.AsyncClient, sub: str = "7", target: str = "/alarms") -> httpx.Response:
    return await browser.get(await confirm(await go_to_provider(browser, target), sub))
