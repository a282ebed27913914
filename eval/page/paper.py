"""Results printed by Luzio, Bernardino and Moreno (2024): YOLOv3 on 300 photographs of their own choice."""

TABLE_SHIFTS = (5, 15, 30)
"""Gaze shifts at which tables I and II give the cumulative performance."""

TABLE_I: dict[str, tuple[float, float, float]] = {
    "predictive-raw": (61.53, 84.60, 93.10),
    "predictive-calibrated": (58.83, 83.53, 92.23),
    "non-predictive-raw": (42.63, 70.53, 87.23),
    "non-predictive-calibrated": (53.80, 80.90, 93.03),
}
"""Cumulative performance at `TABLE_SHIFTS`, in percent."""

TABLE_II: dict[str, tuple[float, float, float]] = {
    "random": (45.20, 84.80, 97.13),
    "vocus2": (15.47, 41.82, 69.13),
    "predictive-calibrated": (58.83, 84.60, 93.10),
    "non-predictive-calibrated": (53.80, 80.90, 93.03),
}
"""Same columns as table I. For predictive search at 15 and 30 shifts, the paper repeats the raw numbers here."""
