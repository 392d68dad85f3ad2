"""What is done about alarms: webhooks, commands, mails and fault-tolerant changes, each at least once by an outbox.

settings = ActionSettings.model_validate(section)
entries = transition_entries(settings, transition, priority, now)  # stored with the transition, in one transaction
attempt = deliver(entry, settings, now)          # attempt.retry_entry takes the entry's place; None: it is removed
"""

from servoscope.service.actions.delivery import deliver, signature
from servoscope.service.actions.fault_tolerance import (
    ControlChange,
    FaultToleranceState,
    accommodate_fault,
)
from servoscope.service.actions.outbox import (
    DeliveryAttempt,
    OutboxEntry,
    diagnosis_entries,
    flood_entries,
    idempotency_key,
    transition_entries,
    trial_entry,
)
from servoscope.service.actions.settings import (
    ActionSettings,
    CommandSettings,
    EmailSettings,
    FaultToleranceSettings,
    MqttMessageSettings,
    RetrySettings,
    WebhookSettings,
)

__all__ = [
    "ActionSettings", "CommandSettings", "ControlChange", "DeliveryAttempt", "EmailSettings",
    "FaultToleranceSettings",
    "FaultToleranceState", "MqttMessageSettings", "OutboxEntry", "RetrySettings", "WebhookSettings",
    "accommodate_fault", "deliver", "diagnosis_entries", "flood_entries", "idempotency_key",
    "signature", "transition_entries", "trial_entry",
]  # fmt: skip
