"""What can go wrong for a user, as one small tree of exceptions whose messages are one line each.

    Exception
      ServoscopeError            catch this one to catch all that servoscope raises on purpose
        LoopError                a loop file or a setting is wrong
        RecordingError           a recording cannot be used
          NotEnoughError         it is usable as a file, but too short or too still to learn from
        BaselineError            a baseline file is unusable, or of another version
        SimulationError          a simulation that was asked for is impossible
        OutputError              a result cannot be written
        ConfigError              a service file is wrong, or what it names
        MessageError             a message from outside holds no block that can be used
        SourceError              what samples come from, or go to, cannot be used
        StoreError               a store cannot be used
          StoreUnavailable       for now: it is full, locked or down; trying again may help
        AlarmError               what an alarm was told to do has no meaning in its state
        StateError               a saved state is of another version, or damaged
        AccessError              a file of users cannot be used, or a user is none

Every message names the file, the row or the key, says what is wrong with it and what to do.
"""

__all__ = [
    "AccessError",
    "AlarmError",
    "BaselineError",
    "ConfigError",
    "LoopError",
    "MessageError",
    "NotEnoughError",
    "OutputError",
    "RecordingError",
    "ServoscopeError",
    "SimulationError",
    "SourceError",
    "StateError",
    "StoreError",
    "StoreUnavailable",
]


class ServoscopeError(Exception):
    """The base of all errors that servoscope raises on purpose; its text is one line for the user."""


class LoopError(ServoscopeError):
    """A loop file, or a setting in it, is wrong."""


class RecordingError(ServoscopeError):
    """A recording cannot be used."""


class NotEnoughError(RecordingError):
    """A recording is too short, or excites too little, for what was asked."""


class BaselineError(ServoscopeError):
    """A baseline file is unusable, or was written by another version."""


class SimulationError(ServoscopeError):
    """A simulation that was asked for is impossible."""


class OutputError(ServoscopeError):
    """A result cannot be written."""


class ConfigError(ServoscopeError):
    """A service file is wrong, or what it names."""


class MessageError(ServoscopeError):
    """A message from outside holds no block that can be used; `kind` names the case, for counts."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class SourceError(ServoscopeError):
    """What samples come from, or go to, cannot be used."""


class StoreError(ServoscopeError):
    """A store cannot be used."""


class StoreUnavailable(StoreError):
    """A store cannot be used for now: it is full, locked or down."""


class AlarmError(ServoscopeError):
    """What an alarm was told to do has no meaning in the state that it is in."""


class StateError(ServoscopeError):
    """A saved state was written by another version, or is damaged."""


class AccessError(ServoscopeError):
    """A file of users cannot be used, or what was asked of it makes no sense."""
