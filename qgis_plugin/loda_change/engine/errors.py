"""What can go wrong with the engine, in words for the user."""


class EngineError(Exception):
    """The engine is missing, failed or died.

    Parameters
    ----------
    message : str
        What happened.
    remedy : str
        What the user can do.
    """

    def __init__(self, message, remedy=""):
        super().__init__(message)
        self.message = message
        self.remedy = remedy

    def __str__(self):
        return f"{self.message} {self.remedy}".strip()


class EngineMissing(EngineError):
    """There is no engine on this computer, or none where the settings say."""


class EngineCancelled(EngineError):
    """The user stopped the run."""
