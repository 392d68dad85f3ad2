"""Nodes subscribed to at a server, and what it grants of what was asked for: sampling intervals, queues, messages."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class ItemTerms(NamedTuple):
    """How a node is watched: the interval at which it is sampled [ms], and how many values the server keeps.

    As it is asked for, or as the server has revised it; `refusal`: why it grants nothing, else empty.
    """

    sampling_ms: float
    queue: int
    refusal: str = ""


class _AnswerRecorder:
    """Stands before a session while items are created: the library returns their numbers, and drops the rest."""

    def __init__(self, session: Any) -> None:
        self._session, self.answers = session, list[Any]()

    def __getattr__(self, name: str) -> Any:
        # the first values may come before the last item is created; they are the session's
        return getattr(self._session, name)

    async def create_monitored_items(self, parameters: Any) -> Any:
        """Create them, and keep the answers."""
        self.answers = await self._session.create_monitored_items(parameters)
        return self.answers


async def monitor_nodes(subscription: Any, wanted: Mapping[str, ItemTerms], first: int) -> dict[str, ItemTerms]:
    """Subscribe to nodes; return what the server grants of each. `first`: number of the first, unique in it."""
    from asyncua import ua
    from asyncua.ua.attribute_ids import AttributeIds

    stamped = ua.DataChangeFilter(Trigger=ua.DataChangeTrigger.StatusValueTimestamp)
    items = [
        ua.MonitoredItemCreateRequest(
            ua.ReadValueId(NodeId=ua.NodeId.from_string(node), AttributeId=AttributeIds.Value),
            ua.MonitoringMode.Reporting,
            ua.MonitoringParameters(ClientHandle=k, SamplingInterval=sampling, QueueSize=queue, Filter=stamped),
        )
        for k, (node, (sampling, queue, _)) in enumerate(wanted.items(), first)
    ]
    session = subscription.server
    subscription.server = recorder = _AnswerRecorder(session)
    try:
        await subscription.create_monitored_items(items)
    finally:
        subscription.server = session
    return {
        node: ItemTerms(one.RevisedSamplingInterval, one.RevisedQueueSize)
        if one.StatusCode.is_good()
        else ItemTerms(0.0, 0, one.StatusCode.name)
        for node, one in zip(wanted, recorder.answers, strict=True)
    }


def publishing_interval(subscription: Any) -> float:
    """Return the time between two messages of a subscription, as the server has revised it [s]."""
    return float(subscription.parameters.RequestedPublishingInterval) / 1000.0


async def shorten_interval(subscription: Any, interval_s: float) -> float:
    """Ask for messages that come so much sooner [s]; return what is granted."""
    from asyncua import ua

    one = subscription.parameters
    answer = await subscription.update(
        ua.ModifySubscriptionParameters(
            SubscriptionId=subscription.subscription_id,
            RequestedPublishingInterval=1000.0 * interval_s,
            RequestedLifetimeCount=one.RequestedLifetimeCount,
            RequestedMaxKeepAliveCount=one.RequestedMaxKeepAliveCount,
            MaxNotificationsPerPublish=one.MaxNotificationsPerPublish,
            Priority=one.Priority,
        )
    )
    return float(answer.RevisedPublishingInterval) / 1000.0
