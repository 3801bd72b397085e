"""A calibration summarised in words."""

import dataclasses

from lsvision.report import calibration_summary


def test_determined(determined):
    text = calibration_summary(determined)
    first, *rest = text.splitlines()
    assert first == "joint calibration of 2 board scan(s), 18 corners: determined"
    assert "(-0.026000, +1.020000, +0.014000)  ± (2.0e-05, 4.0e-05, 6.0e-05)" in rest[0]
    # atan(-0.026 / 1.02) and atan(0.014 / 1.02) in degrees, and the length of n.
    assert "1.020427, turned -1.4602° sideways and +0.7864° in depth" in rest[1]
    assert "2.0000 -> 0.5000 mm (75.0 % better)" in rest[2]
    assert "1 times the corners' stated sigmas" in rest[3]
    # 1000 n1 / n2 and 1000 n3 / n2, their sigmas 1000 sigma / n2.
    assert "-25.490 ± 0.02 mm per metre sideways, +13.725 ± 0.059 mm per metre in depth" in rest[4]
    assert "not measured" not in text
    assert rest[-1].split(maxsplit=1) == ["next", "n is determined"]


def test_prior_dominated(dominated):
    text = calibration_summary(dominated)
    assert "two-step calibration" in text
    assert text.splitlines()[0].endswith(": NOT CONVERGED")
    assert "because      the estimate had not settled after 20 iterations" in text
    assert "not measured (+0.00, +0.00, +1.00): σ stays at 4.9e-02 of the prior's 5.0e-02" in text
    assert text.count("not measured") == 1
    assert "tilt the board by 15 deg" in text.splitlines()[-1]


def test_without_advice(determined):
    observability = dataclasses.replace(determined.observability, advice="")
    assert "next" not in calibration_summary(dataclasses.replace(determined, observability=observability))
