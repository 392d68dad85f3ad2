"""What is done about alarms: webhooks, commands and fault-tolerant changes, each at least once by an outbox.

settings = ActionSettings.model_validate(section)
rows = outgoing(settings, transition, priority, details)    # stored with the transition, in one transaction
delivery = deliver(row, settings, now)                      # delivery.again takes the row's place; None: it goes
"""

from servoscope.actions.delivery import deliver, secret_of, signature
from servoscope.actions.outbox import Delivery, Outgoing, key_of, outgoing, outgoing_diagnosis, outgoing_flood
from servoscope.actions.settings import (
    ActionSettings,
    CommandSettings,
    MessageSettings,
    RetrySettings,
    ToleranceSettings,
    WebhookSettings,
)
from servoscope.actions.tolerance import Change, ToleranceState, begin, respond

__all__ = [
    "ActionSettings",
    "Change",
    "CommandSettings",
    "Delivery",
    "MessageSettings",
    "Outgoing",
    "RetrySettings",
    "ToleranceSettings",
    "ToleranceState",
    "WebhookSettings",
    "begin",
    "deliver",
    "key_of",
    "outgoing",
    "outgoing_diagnosis",
    "outgoing_flood",
    "respond",
    "secret_of",
    "signature",
]
