"""Durations of movements of eye and head, against published values and a simulation."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from semfov import TargetEvidence
from semfov.belief.observers import Target
from semfov.head import Flat, PerSecond, SearchGain, Speeds
from semfov.head.belief import SceneObserver
from semfov.head.gain import OUT
from semfov.head.views import Views
from tests.refusals import refused


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
    views = Views(Flat(torch.rand(3, 480, 640), (40, 30), degree=8))
    belief = SceneObserver(Target(TargetEvidence()), views).start(1, views.grid, torch.zeros(1))
    every = range(len(views))
    for dead_zone in (0.0, 15.0, 25.0):
        gain = PerSecond(SearchGain(views), Speeds(dead_zone=dead_zone), 55, every)
        made = (gain(belief, torch.zeros(1, len(views.grid), dtype=torch.bool))[0] > OUT).unflatten(0, (-1, 100)).any(1)
        turns = (views.poses[:, :2] - views.poses[0, :2]).norm(dim=-1)
        assert made.tolist() == [turn == 0 or turn >= dead_zone for turn in turns.tolist()]


@pytest.mark.parametrize("settings", [{"look": 0.0}, {"head": -1.0}, {"eye": float("nan")}, {"acceleration": 0.0}])
def test_invalid_speeds_are_refused(settings):
    refused(next(iter(settings)), Speeds, **settings)
