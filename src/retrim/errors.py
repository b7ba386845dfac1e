"""Every error that retrim raises on purpose, under one root."""


class RetrimError(Exception):
    """Root of all errors of this package. The message names what was wrong and what would be right."""


class ConfigError(RetrimError, ValueError):
    """A preset, scenario, vehicle, task or reference that does not exist or cannot be used."""


class FrameError(ConfigError):
    """A task, observation or controller that cannot be turned into another frame."""


class PlantError(RetrimError, RuntimeError):
    """A plant refused what it was asked for, or it is gone."""


class JobError(RetrimError, RuntimeError):
    """Work that was handed to another process has failed there, or nobody can be reached who would do it."""


class MessageError(RetrimError, ValueError):
    """Bytes that must not be used: truncated, damaged, of another kind, or with values that are not finite."""


class CheckpointError(RetrimError, ValueError):
    """A file with a policy or with what was learnt that must not be flown."""


class LogError(RetrimError, ValueError):
    """A flight log that cannot be read, or whose columns cannot be what the map says that they are."""


class TrainingError(RetrimError, RuntimeError):
    """Training that has come to nothing: its loss is not a number."""
