"""A plan: joint targets, speeds, clearances, predicted accuracy and the cell for which it was made; its description."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.display import Displayed, Summary
from ftcalib.files import check_format, read_object, write_new
from ftcalib.poses.information import Guess, Prediction, predicted_sigma, special
from ftcalib.rounding import counted
from ftdrive.cell.config import RobotConfig
from ftdrive.errors import BadPlan, PlanRefused
from ftdrive.planning.geometry.certify import Certifier
from ftdrive.planning.geometry.kinematics import wrist_refined
from ftdrive.planning.motion import STILL_RAD, Speeds, arm_moves, move_duration_s, speed_of_leading_joint
from ftdrivers.sweep import WRISTS, Sweep
from ftdrivers.ur.kinematics import Array, Kinematics

PLAN_FORMAT, OLD_FORMAT = "ftdrive.plan/2", "ftdrive.plan/1"
BALL_SAMPLES = 181
# Time between two points of a sweep that are joined by a straight move for the proof, s. The proof keeps additional
# distance for the deviation of the curve from these moves.
PROOF_S = 0.1
JOINTS = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")


@dataclass(frozen=True, slots=True)
class PlanStep:
    """One pose, and the move from it to the next one; the last move leads back to the first pose."""

    number: int
    """Number of the orientation: 1 to 24 as in the paper, from 101 for chosen poses, from 1001 for sets."""
    q_rad: tuple[float, ...]
    R_base_flange: tuple[tuple[float, ...], ...]
    turn_rad: float
    """Angle of the joint that turns most in the move."""
    speed_rad_s: float
    """Speed in the move of the joint that turns most."""
    duration_s: float
    certified: bool
    clearance_m: float
    limited_by: str
    """The two bodies whose distance comes closest to the margin."""


@dataclass(frozen=True, slots=True, repr=False)
class Plan(Displayed):
    """Plan of a closed tour of poses, or of a sweep; `to_dict` defines the plan file."""

    kind: str
    """Kind of plan: constant, wrist, posture, box, cone, reachable, tool, sets, hung, verification or sweep."""
    why: tuple[str, ...]
    """Sentences that say why a plan of this kind was made, and what accuracy it loses."""
    made_for: Mapping[str, str]
    """SHA-256 of the arm's model and kinematics, tool and scene with margins. Files of version 1 lack kinematics."""
    steps: tuple[PlanStep, ...]
    acceleration_rad_s2: float
    ball_m: float
    """Radius of a ball that contains wrist and tool during the whole tour."""
    ball_centre_m: tuple[float, ...]
    """(3,) centre of the ball in base; the crossing of joint axes 4 and 5 if base, shoulder and elbow rest."""
    predicted: Mapping[str, Any]
    description: Mapping[str, Any]
    """Model, kinematics, tool, scene and speeds; see `marked` for `measured` and `emulated`."""
    sweep: Sweep | None = None
    """Curve of a sweep, whose points `steps` contains; None for a tour."""
    off_curve_m: float = 0.0
    """Upper bound on how much less clearance a sweep's curve has than the straight moves between its steps, m."""

    def _summary(self) -> Summary:
        return Summary(f"Plan {self.kind}, {counted(len(self.steps), 'pose')}", notes=_summary(self))

    @property
    def certified(self) -> bool:
        """Whether every move, including the return to the first pose, is proven clear."""
        return all(step.certified for step in self.steps)

    @property
    def arm_rests(self) -> bool:
        """Whether base, shoulder and elbow stay at rest during the whole tour."""
        # If joints 1 to 3 move, the whole arm needs clear space, not only the ball around the wrist.
        return len({step.q_rad[:3] for step in self.steps}) == 1

    @property
    def measured(self) -> bool:
        """Whether the configuration says that tool and scene were measured; otherwise they may be placeholders."""
        return self.description.get("measured") is True

    @property
    def emulated(self) -> bool:
        """Whether the plan was made for an emulated cell."""
        return self.description.get("emulated") is True

    def marked(self, *, measured: bool, emulated: bool = False) -> "Plan":
        """Return the plan with a description that says whether tool and scene were measured.

        For an emulated cell the first sentence says that too. The description is part of the file and its hash.
        """
        if not emulated:
            return replace(self, description={**self.description, "measured": measured})
        words = "The cell is EMULATED: no real arm may follow this plan."
        return replace(
            self, why=(words, *self.why), description={**self.description, "measured": measured, "emulated": True}
        )

    @property
    def kinematics(self) -> Kinematics | None:
        """Kinematics of the arm for which the plan was made; None if they are nominal."""
        stored = self.description.get("kinematics", {"source": "nominal"})
        if stored["source"] == "nominal":
            return None
        return Kinematics.of([*stored["theta_rad"], *stored["a_m"], *stored["d_m"], *stored["alpha_rad"]])

    @property
    def R_base_flange(self) -> Array:
        """Orientations (n, 3, 3) of the poses; they map flange coordinates to base coordinates."""
        return np.array([step.R_base_flange for step in self.steps])

    @property
    def nodes_rad(self) -> Array:
        """Joint vectors (n, 6) at which the arm stands: the poses, or the centre of a sweep."""
        if self.sweep is not None:
            return np.array([self.sweep.centre_rad])
        return np.array([step.q_rad for step in self.steps])

    @property
    def stops(self) -> range:
        """Numbers of the stops, from 1: every pose and the return to the first one; a sweep has one stop."""
        return range(1, 2 if self.sweep else len(self.steps) + 2)

    @property
    def top_speed_rad_s(self) -> float:
        """Largest joint speed of the plan."""
        if self.sweep is not None:
            return float(self.sweep.largest(1).max())
        return max(step.speed_rad_s for step in self.steps)

    @property
    def motion_time_s(self) -> float:
        """Duration of all moves at the speeds of the plan, including the return to the first pose."""
        return float(sum(step.duration_s for step in self.steps))

    def limited(self, certifier: Certifier, speeds: Speeds) -> "Plan":
        """Return the plan with those of its speeds reduced that exceed these limits."""
        q = np.array([step.q_rad for step in self.steps])
        allowed = speed_of_leading_joint(certifier.arm, q, np.roll(q, -1, axis=0), speeds)
        steps = (
            replace(step, speed_rad_s=min(step.speed_rad_s, float(most)))
            for step, most in zip(self.steps, allowed, strict=True)
        )
        acceleration_rad_s2 = min(self.acceleration_rad_s2, speeds.joint_rad_s2)
        return replace(self, steps=tuple(steps), acceleration_rad_s2=acceleration_rad_s2)

    def at_share(self, share: float) -> "Plan":
        """Return the plan of a sweep slowed to this fraction of its speed, along the same curve."""
        if self.sweep is None or share == 1.0:
            return self
        return replace(self, sweep=self.sweep.slower(share), acceleration_rad_s2=self.acceleration_rad_s2 * share**2)

    def in_words(self, *, table: bool = True) -> str:
        """Describe the plan: reason, moves, joint ranges, clearances, duration, space and predicted accuracy.

        The table is at most 72 columns wide; each sentence is one line.
        """
        still = ", ".join(f"{angle:.0f}" for angle in np.degrees(self.steps[0].q_rad[:3]))
        rest = [f"Base, shoulder and elbow stay at {still} degrees."] if self.arm_rests else []
        rows = _table_lines(self) if self.sweep is None else _sweep_table(self.sweep)
        return "\n".join([*self.why, *rest, *([*rows, ""] if table else []), *_summary(self)])

    def stop_in_words(self, robot: RobotConfig) -> str:
        """Describe the time and angle of a stop at the highest speed of the plan; empty for drivers other than "ur"."""
        if robot.driver != "ur":
            return ""
        speed_deg_s, stop_deg_s2 = np.degrees(self.top_speed_rad_s), robot.stop_deceleration_deg_s2
        return (
            f"A stop from {speed_deg_s:.0f} °/s brakes with {stop_deg_s2:.0f} °/s²: the arm rests after "
            f"{speed_deg_s / stop_deg_s2:.2f} s and {speed_deg_s**2 / (2 * stop_deg_s2):.1f}°."
        )

    def room_in_words(self) -> str:
        """Describe the space around the arm that the operator must keep clear."""
        ball = self.ball_in_words()
        if self.arm_rests:
            crossing = "where the axes of wrist 1 and 2 cross"
            return f"All moving parts stay {ball}, {crossing}: keep that space clear and cables slack."
        return f"Wrist and tool stay {ball}, and the whole arm moves: keep the space of both clear and cables slack."

    def ball_in_words(self) -> str:
        """Describe radius and centre of the ball that contains wrist and tool."""
        x, y, z = (f"{value:.2f}" for value in self.ball_centre_m)
        return f"within {self.ball_m:.2f} m of x {x}, y {y}, z {z} m in base"

    @property
    def sha256(self) -> str:
        """SHA-256 of the contents of the plan file."""
        return str(self.to_dict()["sha256"])

    def to_dict(self) -> dict[str, Any]:
        """Return the contents of the file, with a hash of the other entries that reveals later changes."""
        document: dict[str, Any] = {
            "format": PLAN_FORMAT,
            "kind": self.kind,
            "why": list(self.why),
            "poses": len(self.steps),
            "certified": self.certified,
            "uncertified_segments": sum(not step.certified for step in self.steps),
            "max_move_deg": float(np.degrees(max(step.turn_rad for step in self.steps))),
            "motion_time_s": self.motion_time_s,
            "min_clearance_mm": 1e3 * min(step.clearance_m for step in self.steps),
            "ball_m": self.ball_m,
            "ball_centre_m": list(self.ball_centre_m),
            "predicted_sigma": dict(self.predicted),
            "acceleration_rad_s2": self.acceleration_rad_s2,
            "made_for": dict(self.made_for),
            "description": dict(self.description),
            "steps": [asdict(step) for step in self.steps],
        }
        if self.sweep is not None:
            document |= {"sweep": self.sweep.to_dict(), "off_curve_m": self.off_curve_m}
        # Tuples become lists, as after reading the file.
        document = json.loads(json.dumps(document))
        return document | {"sha256": digest(document)}

    def save(self, path: str | Path) -> None:
        """Write the plan to a new file."""
        write_new(path, json.dumps(self.to_dict(), indent=1) + "\n")

    @classmethod
    def load(cls, path: str | Path) -> "Plan":
        """Read a plan; raises `BadPlan` if the file is not a plan, and `PlanRefused` if it was changed."""
        try:
            document = read_object(path, BadPlan)
            if document.get("format") != OLD_FORMAT:
                check_format(document, PLAN_FORMAT, BadPlan)
        except BadPlan as error:
            raise BadPlan(f"{path}: {error}") from error
        document.pop("schema_version", None)  # the output of `ftdrive plan --json` is a plan with this entry
        stored = document.pop("sha256", None)
        if stored != digest(document):
            raise PlanRefused(f"{path} was changed after it was made: make a new plan with `ftdrive plan`")
        steps = tuple(
            PlanStep(
                **{**step, "q_rad": tuple(step["q_rad"]), "R_base_flange": tuple(map(tuple, step["R_base_flange"]))}
            )
            for step in document["steps"]
        )
        return cls(
            document["kind"],
            tuple(document["why"]),
            document["made_for"],
            steps,
            document["acceleration_rad_s2"],
            document["ball_m"],
            tuple(document["ball_centre_m"]),
            document["predicted_sigma"],
            document["description"],
            Sweep.from_dict(document["sweep"]) if "sweep" in document else None,
            document.get("off_curve_m", 0.0),
        )

    def require(self, certifier: Certifier) -> None:
        """Raise `PlanRefused` unless the plan was made for this model, tool and scene, and is still proven clear."""
        now = fingerprints(certifier)
        changed = [name for name in now if name != "kinematics" and self.made_for.get(name) != now[name]]
        if changed:
            raise PlanRefused(f"the plan was made for another {' and another '.join(changed)}: make a new plan")
        q = np.array([step.q_rad for step in self.steps])
        if self.sweep is not None:
            q = self.sweep.at(np.arange(0.0, self.sweep.duration_s, PROOF_S))
        if not certifier.keeping(self.off_curve_m).clear_around(q):
            raise PlanRefused("a move of the plan cannot be proven clear: make a new plan")

    def of_arm(self, certifier: Certifier) -> "Plan":
        """Return the plan with wrist angles and clearances for the kinematics of this arm.

        A plan for another model, tool or scene is returned unchanged; `require` refuses it. Raises `PlanRefused` if a
        move cannot be proven clear with these kinematics.
        """
        now = fingerprints(certifier)
        if {**self.made_for, "kinematics": now["kinematics"]} != now or self.made_for == now:
            return self
        if self.sweep is not None:
            raise PlanRefused("the sweep was planned with other kinematics: make a new plan on this arm")
        q = wrist_refined(certifier.arm.kinematics, self.nodes_rad, self.R_base_flange)
        if np.abs(q).max() > 2 * np.pi:
            q = self.nodes_rad
        following = np.roll(q, -1, axis=0)
        certificate, R = certifier.certify(q, following), certifier.arm.frames(q).R_base_flange
        if not certificate.clear.all():
            whose = "nominal" if certifier.arm.is_nominal else "this arm's own"
            raise PlanRefused(
                f"the plan was made with other kinematics, and with {whose} a move cannot be proven clear: make a new "
                "plan on this arm"
            )
        centre_m, ball_m = ball_of(certifier, q, following)
        steps = tuple(
            replace(
                step,
                q_rad=tuple(q[i].tolist()),
                turn_rad=float(np.abs(following[i] - q[i]).max()),
                R_base_flange=tuple(tuple(row) for row in R[i].tolist()),
                certified=bool(certificate.clear[i]),
                clearance_m=float(certificate.clearance_m[i]),
                limited_by=certificate.limited_by[i],
            )
            for i, step in enumerate(self.steps)
        )
        return replace(
            self,
            made_for=now,
            steps=steps,
            ball_m=ball_m,
            ball_centre_m=tuple(centre_m.tolist()),
            description={**self.description, "kinematics": _describe_kinematics(certifier)},
        )


def make_plan(
    kind: str,
    why: Sequence[str],
    certifier: Certifier,
    numbers: Sequence[int],
    q_rad: Array,
    speeds: Speeds,
    guess: Guess,
) -> Plan:
    """Certify a closed tour, and predict its accuracy for the assumed tool and noise.

    Parameters
    ----------
    why : sequence of str
        Sentences about the reason; the predicted error is appended.
    numbers : sequence of int
        Numbers of the orientations.
    q_rad : array, shape (n, 6)
        Joint vectors in the order of travel.
    """
    arm, following = certifier.arm, np.roll(q_rad, -1, axis=0)
    certificate = certifier.certify(q_rad, following)
    R = arm.frames(q_rad).R_base_flange
    turn = np.abs(following - q_rad).max(axis=1)
    speed = speed_of_leading_joint(arm, q_rad, following, speeds)
    duration = move_duration_s(turn, speed, speeds.joint_rad_s2)
    prediction = predicted_sigma(R, guess)
    all_24 = predicted_sigma(special(range(1, 25)), guess).force_rms_N
    words = f"Predicted error of force compensation: {prediction.force_rms_N:.3f} N"
    if set(numbers) != set(range(1, 25)):
        words += f", {prediction.force_rms_N / all_24:.2f} times that of all 24 poses"
    ball_centre_m, ball_m = ball_of(certifier, q_rad, following)
    steps = tuple(
        PlanStep(
            int(numbers[i]),
            tuple(q_rad[i].tolist()),
            tuple(tuple(row) for row in R[i].tolist()),
            float(turn[i]),
            float(speed[i]),
            float(duration[i]),
            bool(certificate.clear[i]),
            float(certificate.clearance_m[i]),
            certificate.limited_by[i],
        )
        for i in range(len(q_rad))
    )
    return Plan(
        kind,
        (*why, f"{words}."),
        fingerprints(certifier),
        steps,
        speeds.joint_rad_s2,
        ball_m,
        tuple(ball_centre_m.tolist()),
        _prediction_json(prediction),
        describe_plan(certifier, speeds, guess),
    )


def describe_plan(certifier: Certifier, speeds: Speeds, guess: Guess) -> dict[str, Any]:
    """Return the `description` of a plan."""
    return {
        "model": certifier.arm.name,
        "kinematics": _describe_kinematics(certifier),
        "tool": [asdict(part) for part in certifier.arm.tool],
        **({} if certifier.arm.hung is None else {"hung": asdict(certifier.arm.hung)}),
        "scene": certifier.scene.describe(),
        "margins": asdict(certifier.margins),
        "speeds": asdict(speeds),
        "guess": {
            "mass_kg": guess.mass_kg,
            "sigma_force_N": guess.sigma_force_N,
            "sigma_torque_Nm": guess.sigma_torque_Nm,
            "gain_sigma": guess.gain_sigma,
        },
    }


def _describe_kinematics(certifier: Certifier) -> dict[str, Any]:
    """Return the entry `kinematics` of a description: source, theta, a, d and alpha of all joints."""
    source = "nominal" if certifier.arm.is_nominal else "controller"
    return {"source": source, **asdict(certifier.arm.kinematics)}


def ball_of(certifier: Certifier, start_rad: Array, end_rad: Array) -> tuple[Array, float]:
    """Return centre (3,) in base and radius of a ball that contains wrist and tool during all moves, m."""
    share = np.linspace(0, 1, BALL_SAMPLES)[:, None, None]
    wrist_m = certifier.arm.frames(((1 - share) * start_rad + share * end_rad).reshape(-1, 6)).wrist_m
    centre_m = (wrist_m.min(axis=0) + wrist_m.max(axis=0)) / 2
    # Between two samples the wrist centre is outside the ball around the samples by at most half a step.
    step_m = np.linalg.norm(np.diff(wrist_m.reshape(BALL_SAMPLES, -1, 3), axis=0), axis=2).max()
    away_m = np.linalg.norm(wrist_m - centre_m, axis=1).max() + step_m / 2
    return centre_m, certifier.arm.ball_m + float(away_m)


def fingerprints(certifier: Certifier) -> dict[str, str]:
    """Return the SHA-256 of each part of a cell on which the proof of clearance depends, such as tool and scene."""
    hung = [] if certifier.arm.hung is None else [asdict(certifier.arm.hung)]
    return {
        "model": digest(certifier.arm.describe()),
        "kinematics": digest(_describe_kinematics(certifier)),
        "tool": digest([*(asdict(part) for part in certifier.arm.tool), *hung]),
        "scene": digest([certifier.scene.describe(), asdict(certifier.margins)]),
    }


def digest(value: Any) -> str:
    """Return the SHA-256 of a value as JSON with sorted keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


def _prediction_json(prediction: Prediction) -> dict[str, Any]:
    """Return predicted sigmas and condition numbers as JSON values; None for what the poses do not determine."""
    values: dict[str, Any] = {name: np.asarray(sigma).tolist() for name, sigma in prediction.sigma.items()}
    for name in ("force_rms_N", "torque_rms_Nm", "cond9", "cond_u1", "second_basin_gap"):
        values[name] = getattr(prediction, name)

    def finite(value: Any) -> Any:
        if isinstance(value, list):
            return [finite(item) for item in value]
        return value if np.isfinite(value) else None

    return {name: finite(value) for name, value in values.items()}


def way_in_words(way_rad: ArrayLike, clearance_m: float) -> str:
    """Describe an approach: number of moves, range of each joint, clearance, and whether the whole arm moves."""
    count = len(np.asarray(way_rad)) - 1
    words = f"{counted(count, 'move')} ({turns_in_words(way_rad)}), "
    words += f"proven clear by {1e3 * clearance_m:.0f} mm"
    return words + "; the whole arm moves: keep its space clear" if arm_moves(way_rad) else words


def turns_in_words(way_rad: ArrayLike) -> str:
    """Describe which joints turn along a path of joint vectors, and each joint's range in degrees."""
    ranges_deg = np.degrees(np.ptp(np.asarray(way_rad), axis=0))
    turns = [
        f"{name} {turn:.0f}°" for name, turn in zip(JOINTS, ranges_deg, strict=True) if turn >= np.degrees(STILL_RAD)
    ]
    return ", ".join(turns) or "no joint moves by 0.5° or more"


def _table_lines(plan: Plan) -> list[str]:
    q_deg = np.degrees([step.q_rad for step in plan.steps])
    shown = range(3 if plan.arm_rests else 0, 6)
    widths = [max(len(JOINTS[j]), 5) + 1 for j in shown]

    def angles(row: Array) -> str:
        return "".join(f"{row[j]:{width}.0f}" for j, width in zip(shown, widths, strict=True))

    names = "".join(f"{JOINTS[j]:>{width}}" for j, width in zip(shown, widths, strict=True))
    title = "Joint angles of the poses in degrees, and the move to the next pose:"
    lines = [title, f"{'':4}{'R':>4}{names} turn  °/s    s clear mm"]
    for i, (step, q) in enumerate(zip(plan.steps, q_deg, strict=True), start=1):
        turn, speed = np.degrees([step.turn_rad, step.speed_rad_s])
        move = f"{turn:5.0f}{speed:5.0f}{step.duration_s:5.1f}{1e3 * step.clearance_m:9.0f}"
        lines.append(f"{i:4}  {step.number:02d}{angles(q)}{move}")
    return [*lines, f"{'from':8}{angles(q_deg.min(axis=0))}", f"{'to':8}{angles(q_deg.max(axis=0))}"]


def _sweep_table(sweep: Sweep) -> list[str]:
    t = np.arange(0.0, sweep.duration_s, 0.05)
    q_deg, speed, acceleration = np.degrees(sweep.at(t)), np.degrees(sweep.largest(1)), np.degrees(sweep.largest(2))
    lines = [f"Joint angles in degrees during {sweep.duration_s:.0f} s:", f"{'':10}begin  from    to  °/s  °/s²"]
    for j in WRISTS:
        low, high = q_deg[:, j].min(), q_deg[:, j].max()
        lines.append(f"  {JOINTS[j]:8}{q_deg[0, j]:5.0f}{low:6.0f}{high:6.0f}{speed[j]:5.0f}{acceleration[j]:6.0f}")
    return lines


def _summary(plan: Plan) -> list[str]:
    nearest = min(plan.steps, key=lambda step: step.clearance_m)
    if plan.sweep is None:
        count, most = len(plan.steps), np.degrees(max(step.turn_rad for step in plan.steps))
        proven = "all proven clear" if plan.certified else "NOT ALL PROVEN CLEAR"
        motion = (
            f"{count} poses, {count} moves {proven}, none larger than {most:.0f}°: "
            f"{plan.motion_time_s:.0f} s of motion at the plan's speeds."
        )
    else:
        proven = "proven clear along its whole length" if plan.certified else "NOT PROVEN CLEAR"
        motion = f"A smooth curve from rest to rest, {proven}, with up to {1e3 * plan.off_curve_m:.0f} mm of deviation."
    return [
        motion,
        f"Smallest clearance: {1e3 * nearest.clearance_m:.0f} mm, {nearest.limited_by}.",
        plan.room_in_words(),
        *([] if plan.kind in ("verification", "tool", "hung", "sweep") else [_accuracy(plan)]),
    ]


def _accuracy(plan: Plan) -> str:
    sigma, guess = plan.predicted, plan.description["guess"]
    # Plan files of ftdrive 0.1.0 contain no assumed gain error of the sensor.
    gain = f", a sensor gain error of {100 * guess['gain_sigma']:.2g} %" if "gain_sigma" in guess else ""
    tilt_deg = np.degrees(_largest_sigma([sigma["tilt_alpha_rad"], sigma["tilt_beta_rad"]]))
    return (
        f"Predicted for {guess['mass_kg']:g} kg{gain}, and averages with a sigma of {guess['sigma_force_N']} N, "
        f"{guess['sigma_torque_Nm']} N·m; sigma of the results: mass {1e3 * _largest_sigma(sigma['mass_kg']):.2g} g, "
        f"centre of mass {1e3 * _largest_sigma(sigma['p_sensor_com_m']):.2g} mm, "
        f"force bias {_largest_sigma(sigma['force_bias_N']):.3f} N, tilt {tilt_deg:.2f}°; "
        f"compensation {_largest_sigma(sigma['force_rms_N']):.3f} N, {_largest_sigma(sigma['torque_rms_Nm']):.4f} N·m."
    )


def _largest_sigma(sigma: object) -> float:
    """Return the largest of some sigmas from a plan file; NaN if the poses do not determine one, stored as null."""
    return float(np.max(np.array(sigma, dtype=np.float64)))
