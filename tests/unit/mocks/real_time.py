"""The computer's clock as the tests of emulators see it: it moves only when they say so."""


class RealTime:
    """Starts at 1000 s; pass it to `CellClock` in place of `time.monotonic_ns`."""

    def __init__(self) -> None:
        self.ns = 1_000_000_000_000

    def __call__(self) -> int:
        return self.ns

    def pass_s(self, duration_s: float) -> None:
        self.ns += round(duration_s * 1e9)
