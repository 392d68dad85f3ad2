"""The exceptions that servoscope raises on purpose, as one small tree; each message is one line.

    Exception
      ServoscopeError            the base of all
        LoopError                a loop file or a setting is wrong
        RecordingError           a recording cannot be used
          EmptyRecordingError    it is a file without a row
          NotEnoughError         it is usable as a file, but too short or too still to learn from
          IrregularTimeError     its rows come at no fixed rate, and nobody said that they are to be resampled
        BaselineError            a baseline file is unusable, or of another version
        SimulationError          a simulation is impossible
        OutputError              a result cannot be written
        ConfigError              a service file is wrong, or what it names
        MessageError             a message from outside holds no usable block
        SourceError              a source or a sink of samples cannot be used
        StoreError               a store cannot be used
          StoreUnavailableError  for now: it is full, locked or down; trying again may help
        AlarmError               a command makes no sense in the state of the alarm
        StateError               a saved state is of another version, or damaged
        AccessError              a file of users cannot be used, or a user is unknown

Every message names the file, the row or the key, says what is wrong with it and what to do.
"""


class ServoscopeError(Exception):
    """The base of all errors that servoscope raises on purpose; its text is one line for the user.

    Examples
    --------
    >>> try:
    ...     ss.read("sunday.csv")
    ... except ServoscopeError as error:
    ...     print(error)
    sunday.csv: no such file, check the path of the recording
    """


class LoopError(ServoscopeError):
    """A loop file, or a setting in it, is wrong."""


class RecordingError(ServoscopeError):
    """A recording cannot be used."""


class EmptyRecordingError(RecordingError):
    """A file holds no row."""


class NotEnoughError(RecordingError):
    """A recording is too short, or excites too little, for what was asked."""


class IrregularTimeError(RecordingError):
    """The rows of a recording come at no fixed rate."""


class BaselineError(ServoscopeError):
    """A baseline file is unusable, or was written by another version."""


class SimulationError(ServoscopeError):
    """A simulation is impossible."""


class OutputError(ServoscopeError):
    """A result cannot be written."""


class ConfigError(ServoscopeError):
    """A service file is wrong, or what it names."""


class MessageError(ServoscopeError):
    """A message from outside holds no usable block; `kind` names the case, for counts."""

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(text)
        self.kind = kind


class SourceError(ServoscopeError):
    """A source or a sink of samples cannot be used."""


class StoreError(ServoscopeError):
    """A store cannot be used."""


class EmptyStoreError(StoreError):
    """A store holds no tables yet: it is none, or another process is making it."""


class StoreUnavailableError(StoreError):
    """A store cannot be used for now: it is full, locked or down."""


class AlarmError(ServoscopeError):
    """A command makes no sense in the state of the alarm."""


class PrognosisError(ServoscopeError):
    """A series of sizes cannot be read, or says nothing that a prognosis could rest on."""


class StateError(ServoscopeError):
    """A saved state was written by another version, or is damaged."""


class AccessError(ServoscopeError):
    """A file of users cannot be used, or what was asked of it makes no sense."""


class ObsoleteSettingWarning(FutureWarning):
    """A file has a setting of an earlier version; the text says what takes its place."""
