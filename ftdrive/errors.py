"""What can go wrong in the application itself."""


class ConfigError(Exception):
    """The configuration or the combination of options cannot be used."""


class NotAccepted(Exception):
    """The result is not good enough to be kept, or differs from what it must equal."""


class BadPlan(Exception):
    """A file is no plan."""


class PlanRefused(NotAccepted):
    """No motion is proven clear, or a plan was made for something else than what is there now."""


class Declined(Exception):
    """A person said no to what was asked, or nobody was there to answer."""
