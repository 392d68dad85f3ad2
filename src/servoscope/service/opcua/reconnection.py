"""What a client may rely on that comes back after a restart (Part 4 of OPC UA), where the library's server differs."""

from __future__ import annotations

import secrets
from typing import Any

from servoscope.service.opcua.settings import import_ua


def follow_standard(iserver: Any) -> None:
    """Mend the services by which clients recover sessions, subscriptions and messages of the library's server."""
    _draw_identifiers(iserver)
    _refuse_lost_messages(iserver.subscription_service)


def _draw_identifiers(iserver: Any) -> None:
    """Let numbers of subscriptions begin anywhere, and draw the tokens of sessions at random.

    The library counts both from the same number in each process. A client that asked for its old ones after a restart
    got those of whoever had connected first, and with them the alarms of that list.
    """
    ua, create = import_ua(), iserver.create_session
    iserver.subscription_service._sub_id_counter = secrets.randbelow(2**31)

    def create_session(*words: Any, **keys: Any) -> Any:
        session = create(*words, **keys)
        iserver.unregister_external_session(session)
        session.auth_token = ua.NodeId(secrets.token_bytes(32))
        iserver.register_external_session(session)
        return session

    iserver.create_session = create_session


def _refuse_lost_messages(subscriptions: Any) -> None:
    """Refuse a message that is not kept: the library answers with an empty one, and clients ask again without end."""
    from asyncua.common.utils import ServiceError

    codes = import_ua().StatusCodes

    def republish(request: Any) -> Any:
        subscription = subscriptions.subscriptions.get(request.SubscriptionId)
        if subscription is None:
            raise ServiceError(codes.BadSubscriptionIdInvalid)
        kept = subscription._not_acknowledged_results.get(request.RetransmitSequenceNumber)
        if kept is None:
            raise ServiceError(codes.BadMessageNotAvailable)
        return kept.NotificationMessage

    subscriptions.republish = republish
