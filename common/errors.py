"""What can go wrong, by name. Every message says what was wrong, where, and what to do."""


class LuojiaError(Exception):
    """Root of every error that Luojia raises on purpose."""


class ConfigError(LuojiaError):
    """A setting is unknown or impossible; the message names the key, the value and what is allowed."""


class WireError(LuojiaError):
    """Bytes or fields do not fit their schema; the message names the message and the field."""


class SourceError(LuojiaError):
    """A source cannot be opened or read; the message names the URL and what is accepted."""


class DeviceError(LuojiaError):
    """A device cannot be opened or read; the message names its place and what to do."""


class CalibrationError(LuojiaError):
    """A recording or a set of images cannot tell what is asked; the message names what is missing."""


class BusError(LuojiaError):
    """The bus cannot be opened or reached; the message names the endpoint."""


class StoreError(LuojiaError):
    """The ground store cannot be opened, read or written; the message names the file."""


class ExportError(LuojiaError):
    """A product cannot be written; the message names the file and the reason."""


class EvaluationError(LuojiaError):
    """Two results cannot be compared; the message names the files and what is missing."""
