"""A calibration in plain words, for the terminal."""

import math
from pathlib import Path

from lsvision.report.installation_words import installation_lines
from lsvision.types import BoardFit, Calibration, Motion


def calibration_summary(calibration: Calibration) -> str:
    """The motion with its sigma, the directions that were not measured, and the advice on what to scan next."""
    motion, observability = calibration.motion, calibration.observability
    n, sigma = motion.n.tolist(), motion.sigma.tolist()
    angle_x, angle_z = (math.degrees(math.atan2(n[i], n[1])) for i in (0, 2))
    corners = sum(board.corners for board in calibration.boards)
    lines = [
        f"{calibration.method.replace('_', '-')} calibration of {len(calibration.boards)} board scan(s), "
        f"{corners} corners: {calibration.verdict if calibration.usable else calibration.verdict.upper()}",
        f"  motion n     {_vector(n)}  ± {_vector(sigma, '.1e')}",
        f"  stretch      {motion.stretch:.6f}, turned {angle_x:+.4f}° sideways and {angle_z:+.4f}° in depth",
        f"  RMSE         {calibration.rmse_before_mm:.4f} -> {calibration.rmse_after_mm:.4f} mm "
        f"({100 * calibration.improvement:.1f} % better)",
        f"  noise        {math.sqrt(calibration.noise_scale):.2g} times the corners' stated sigmas",
        f"  drift        {drift_in_words(motion)}",
    ]
    lines += [f"  allowed for  {error.in_words}" for error in calibration.errors_along_scan]
    lines += [f"  lines of     {board_motion_in_words(board)}" for board in calibration.boards if board.line_motion]
    lines += [f"  because      {reason}" for reason in calibration.reasons if reason != observability.advice]
    lines += [f"  note         {note}" for note in calibration.notes]
    unknown = [direction for direction in observability.directions if not direction.observed]
    lines += [
        f"  not measured {_vector(direction.vector, '+.2f')}: σ stays at {direction.posterior_sigma:.1e} "
        f"of the prior's {direction.prior_sigma:.1e}"
        for direction in unknown
    ]
    if observability.advice:
        lines.append(f"  next         {observability.advice}")
    lines += installation_lines(calibration.installation)
    return "\n".join(lines)


def board_motion_in_words(board: BoardFit) -> str:
    """The motion of a board's scan from line to line: the components that are there or may be."""
    named = [finding.in_words for finding in board.line_motion if finding.state != "absent"]
    return f"{Path(board.scan).name}: {'; '.join(named) or 'still'}"


def drift_in_words(motion: Motion) -> str:
    """How far the object moves off the nominal direction per metre, with its sigma."""
    sigma = (1000.0 / motion.n[1] * motion.sigma).tolist()
    return ", ".join(
        f"{value:+.3f} ± {sigma[axis]:.2g} mm per metre {where}"
        for value, axis, where in zip(motion.drift_mm_per_m, (0, 2), ("sideways", "in depth"), strict=True)
    )


def _vector(values: list[float] | tuple[float, float, float], spec: str = "+.6f") -> str:
    return "(" + ", ".join(format(value, spec) for value in values) + ")"
