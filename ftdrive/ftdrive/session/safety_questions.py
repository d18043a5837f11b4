"""Questions that only the operator can answer before the arm moves."""

from ftcalib.model import Array
from ftdrive.planning.approach import arm_moves
from ftdrive.planning.plan import Plan
from ftdrive.planning.show.words import point_in_words, turns_in_words
from ftdrive.session.open_cell import OpenCell


class SafetyQuestions:
    """Asks for a free tool, free room, the emergency stop, and reduced mode; raises `Declined` unless all are yes."""

    def __init__(self, cell: OpenCell, plan: Plan) -> None:
        self._arm, self._journal, self._plan = cell.arm, cell.journal, plan
        self._reduced = False  # whether the operator has confirmed the reduced mode that is active

    def ask(self, way_rad: Array, *, assumed: bool) -> None:
        """Ask everything before the arm moves along `way_rad` (k, 6); with `assumed`, `--yes` may answer."""
        room = "" if self._plan.arm_rests else ", and the space of the whole arm, which moves too,"
        if arm_moves(way_rad):
            room = f", and the space of the whole arm, which moves in the approach ({turns_in_words(way_rad)}),"
        for text in (
            "Is the tool free: no contact, no workpiece, no fluid, cables slack? Is the base bolted?",
            f"Is the ball of {self._plan.ball_m:.2f} m around {point_in_words(self._plan)} (the wrist){room} free of "
            "obstacles and people?",
            "Is the emergency stop in reach, and tested?",
        ):
            self._journal.require(text, assumed=assumed)
        self.ask_reduced(assumed=assumed)

    def ask_reduced(self, *, assumed: bool) -> None:
        """Ask whether reduced mode is intended, once as long as it lasts."""
        reduced = self._arm.status().safety_mode == "reduced"
        if reduced and not self._reduced:
            self._journal.require("The controller is in reduced mode. Is that intended?", assumed=assumed)
        self._reduced = reduced
