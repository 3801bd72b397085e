"""How to align the cameras, as the files of a calibration hold it: it follows from n, and is not read again."""

from dataclasses import asdict

from lsvision.types import Installation, Turn


def installation_to_dict(installation: Installation | None) -> dict[str, object] | None:
    """Plain data; a turn that was not observed has no angle, nor has the pitch one to set."""
    if installation is None:
        return None
    pitch = installation.pitch
    to_set = {"line_pitch_mm": pitch.true_mm, "encoder_ratio": pitch.encoder_ratio} if pitch.observed else None
    return {
        "verdict": installation.verdict,
        "angle_deg": installation.angle_deg,
        "sigma_deg": installation.sigma_deg,
        "tolerance_deg": installation.tolerance_deg,
        "turn_cameras_deg": {"about_x": _turn(installation.about_x), "about_z": _turn(installation.about_z)},
        "mounting_points": {item.name: _without_name(asdict(item)) for item in installation.shifts},
        "line_pitch": {
            "nominal_mm": pitch.nominal_mm,
            "stretch": pitch.stretch,
            "stretch_sigma": pitch.stretch_sigma,
            "set": to_set,
        },
        "transport": installation.transport,
    }


def _turn(turn: Turn) -> dict[str, float | None]:
    return {"angle": turn.angle_deg if turn.observed else None, "sigma": turn.sigma_deg}


def _without_name(entries: dict[str, object]) -> dict[str, object]:
    return {key: value for key, value in entries.items() if key != "name"}
