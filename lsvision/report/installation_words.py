"""How to align the cameras, in plain words."""

from lsvision.types import Installation, Turn


def installation_lines(installation: Installation | None) -> list[str]:
    """Lines for the terminal."""
    if installation is None:
        return []
    lines = [f"  installation {angle_in_words(installation)}"]
    lines += [f"  turn         {sentence}" for sentence in turns_in_words(installation)]
    lines += [f"  shim         {sentence}" for sentence in _shifts_in_words(installation)]
    return [*lines, f"  line pitch   {pitch_in_words(installation)}", f"  then         {after_in_words(installation)}"]


def angle_in_words(installation: Installation) -> str:
    """How far the motion is off the cameras' Y axis, with the verdict."""
    verdict = {
        "within tolerance": "within the tolerance of",
        "outside tolerance": "outside the tolerance of",
        "not known": "not known well enough for the tolerance of",
    }[installation.verdict]
    return (
        f"the object moves {installation.angle_deg:.3f} ± {installation.sigma_deg:.1g} deg off the cameras' Y axis: "
        f"{verdict} {installation.tolerance_deg:g} deg"
    )


def turns_in_words(installation: Installation) -> list[str]:
    """One sentence for each turn, the first one to make first."""
    comes, goes = "where the object comes from", "where the object goes"
    larger_y, smaller_y = (comes, goes) if installation.transport == "forward" else (goes, comes)
    about_x, about_z = installation.about_x, installation.about_z
    side = larger_y if about_x.angle_deg > 0 else smaller_y
    towards = larger_y if about_z.angle_deg > 0 else smaller_y
    return [
        _turn(about_x, "sensor", f"the side {side} moves nearer to the object"),
        _turn(about_z, "viewing", f"the end at the larger columns moves to {towards}"),
    ]


def pitch_in_words(installation: Installation) -> str:
    """The line pitch to state, or the encoder ratio to set."""
    pitch = installation.pitch
    if not pitch.observed:
        return "no advice: the boards do not show the stretch"
    by_ratio = f"set {pitch.encoder_ratio:.6f} times the encoder pulses per line"
    if pitch.true_mm is None:
        return f"{by_ratio} (stretch {pitch.stretch:.6f} ± {pitch.stretch_sigma:.1g})"
    return (
        f"state {pitch.true_mm:.7g} mm (± {100 * pitch.stretch_sigma / pitch.stretch:.1g} %) in place of "
        f"{pitch.nominal_mm:g} mm, or {by_ratio}"
    )


def after_in_words(installation: Installation) -> str:
    """What is left once the advice was followed."""
    left = [
        f"{name} {0.0 if turn.observed else turn.angle_deg:+.3f} ± {turn.sigma_deg:.1g} deg"
        for name, turn in (("sideways", installation.about_z), ("in depth", installation.about_x))
    ]
    pitch = installation.pitch
    return f"{', '.join(left)}, stretch {1.0 if pitch.observed else pitch.stretch:.6f} ± {pitch.stretch_sigma:.1g}"


def _turn(turn: Turn, axis: str, in_words: str) -> str:
    if not turn.observed:
        return f"no advice about the {axis} axis: the boards do not show it (± {turn.sigma_deg:.2g} deg)"
    name = turn.axis.upper()
    return (
        f"the cameras by {abs(turn.angle_deg):.3f} ± {turn.sigma_deg:.1g} deg about the {axis} axis, "
        f"so that {in_words} ({turn.angle_deg:+.3f} deg about {name})"
    )


def _shifts_in_words(installation: Installation) -> list[str]:
    return [
        f"{item.name}: {item.shift_mm[1]:+.3f} mm along Y, {item.shift_mm[2]:+.3f} mm towards the object"
        for item in installation.shifts
    ]
