"""What can go wrong in the application itself."""


class ConfigError(Exception):
    """The configuration or the combination of options cannot be used."""


class NotAccepted(Exception):
    """The result is not good enough to be kept, or differs from what it must equal."""
