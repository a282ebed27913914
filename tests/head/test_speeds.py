"""Durations of movements of eye and head, against published values and a simulation."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov.errors import InputError
from semfov.head import Speeds


@given(st.floats(0.5, 180), st.floats(20, 400), st.floats(50, 2000))
def test_the_head_turns_as_a_motor_with_bounded_speed_and_acceleration(angle, speed, acceleration):
    found = float(Speeds(head=speed, acceleration=acceleration).turn(torch.tensor(angle, dtype=torch.float64)))
    # Step by step: accelerate as long as there is room to brake.
    step, time, done, pace = found / 20_000, 0.0, 0.0, 0.0
    while done < angle and time < 2 * found:
        braking = pace**2 / (2 * acceleration) >= angle - done
        pace = max(pace - acceleration * step, 1e-9) if braking else min(pace + acceleration * step, speed)
        done, time = done + pace * step, time + step
        if braking and pace <= acceleration * step:
            break
    assert time == pytest.approx(found, rel=0.01)


def test_durations_of_movements_follow_the_main_sequence_and_settling():
    speeds = Speeds()
    eye, head, zoom = torch.tensor(20.0), torch.tensor(90.0), torch.tensor(-3.0)
    none = torch.tensor(0.0)
    assert float(speeds.duration(none, none, none)) == speeds.look
    assert float(speeds.duration(eye, head, none)) == pytest.approx(speeds.look + float(speeds.turn(head)))
    assert float(speeds.duration(eye, none, none)) == pytest.approx(speeds.look + float(speeds.saccade(eye)))
    assert float(speeds.duration(eye, head, zoom)) == pytest.approx(speeds.look + 3 * speeds.zoom)
    # 21 ms plus 2.2 ms per degree (Carpenter, 1988); a saccade of 0° takes no time.
    found = Speeds().saccade(torch.tensor([0.0, 5.0, 10.0, 20.0]))
    torch.testing.assert_close(found, torch.tensor([0.0, 0.032, 0.043, 0.065]))
    plain, slow, none = Speeds(), Speeds(settle=0.4), torch.tensor(0.0)
    eye, head, zoom = torch.tensor(20.0), torch.tensor(90.0), torch.tensor(-1.0)
    for moved, later in (((eye, none, none), 0.0), ((eye, head, none), 0.4), ((none, none, zoom), 0.4)):
        assert float(slow.duration(*moved) - plain.duration(*moved)) == pytest.approx(later)


def test_turns_within_the_dead_zone_are_not_made():
    angles = torch.tensor([0.0, 1.0, 4.9, 5.0, 90.0])
    assert Speeds(dead_zone=5.0).worthwhile(angles).tolist() == [True, False, False, True, True]
    assert Speeds().worthwhile(angles).all()


@pytest.mark.parametrize("settings", [{"look": 0.0}, {"head": -1.0}, {"eye": float("nan")}, {"acceleration": 0.0}])
def test_invalid_speeds_are_refused(settings):
    with pytest.raises(InputError, match=next(iter(settings))):
        Speeds(**settings)
