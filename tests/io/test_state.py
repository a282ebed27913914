"""The state of a module with other settings is refused; states without settings are loaded as they are."""

import io

import pytest
import torch
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from semfov import ActivePerception, Eye, FovealObservationModel, Foveation, InputError
from semfov.belief import Verification
from semfov.io.state import without_settings
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.sensor import LogPolar, MultiScaleFovea
from semfov.zoom import GlimpseEvidence
from tests.small import Blobs, Coloured, agent

PAIRS = {
    "class names": (lambda names: FovealObservationModel.identity(names, edges=[0.2]), ["cup", "cat"], ["cat", "cup"]),
    "edges of levels": (lambda edge: FovealObservationModel.identity(["cup"], edges=[0.2], epsilon=edge), 1e-3, 1e-6),
    "growth": (lambda growth: Foveation(20.0, growth=growth), 1.0, 2.0),
    "levels": (lambda levels: Foveation(20.0, levels), 3, 5),
    "convention": (lambda convention: Foveation(20.0, convention=convention), "kornia", "opencv"),
    "fovea": (LogPolar, 10.0, 20.0),
    "side": (MultiScaleFovea, 32, 64),
    "reference": (lambda reference: Eye(Foveation(9.0), Blobs(), reference=reference), 640.0, 64.0),
    "classes of a detector": (lambda names: Coloured(names), ("red", "blue"), ("blue", "red")),
    "a part of an agent": (lambda names: agent(Coloured(names)), ("red", "blue"), ("blue", "red")),
}


@pytest.mark.parametrize("kind", PAIRS)
@pytest.mark.parametrize("file", ["memory", "torch", "safetensors"])
def test_the_state_of_other_settings_is_refused(kind, file):
    make, one, other = PAIRS[kind]
    state = make(one).state_dict()
    if file == "torch":
        torch.save(state, stream := io.BytesIO())
        stream.seek(0)
        state = torch.load(stream, weights_only=True)
    elif file == "safetensors":
        state = load_tensors(save_tensors(without_shared(state)))
    if file != "safetensors" or len(state) == len(make(one).state_dict()):
        make(one).load_state_dict(state)
    with pytest.raises(InputError, match=r"state_dict: expected the state of an? .* with "):
        make(other).load_state_dict(state, strict=False)


def without_shared(state):
    """Without tensors that are there under another name, which safetensors refuses."""
    seen = {}
    return {name: value for name, value in state.items() if seen.setdefault(value.data_ptr(), name) == name}


@pytest.mark.parametrize("kind", PAIRS)
def test_a_state_without_settings_is_loaded(kind):
    """As files of models hold it."""
    make, one, other = PAIRS[kind]
    make(other).load_state_dict(without_settings(make(one).state_dict()))


def test_learned_settings_are_no_obstacle():
    """A width that is a parameter is loaded, and so are values that a fit changes."""
    source, target = Foveation(10.0, learnable=True), Foveation(30.0, learnable=True)
    target.load_state_dict(source.state_dict())
    assert float(target.sigma.detach()) == pytest.approx(10.0)
    assert all(isinstance(value, torch.Tensor) for value in source.state_dict().values())


def deciding_modules():
    """One of each kind that decides at thresholds, of which none are chosen yet."""
    presence = Presence(torch.tensor(0.0), torch.ones(2), torch.full((2,), 0.5))
    return {
        "presence": presence,
        "verification": Verification(),
        "evidence": GlimpseEvidence(2),
        "model": FovealObservationModel.identity(["cup", "cat"], [0.2], presence=presence),
    }


@pytest.mark.parametrize("kind", deciding_modules())
def test_thresholds_are_in_the_state(kind):
    """Tensors alone have none; then those of the module stay. Settings that differ are refused still."""
    chosen = Thresholds(0.7, 0.1, 0.05)
    source, target = deciding_modules()[kind], deciding_modules()[kind]

    def decides(module):
        return module.presence if kind == "model" else module

    decides(source).thresholds = chosen
    torch.save(source.state_dict(), stream := io.BytesIO())
    stream.seek(0)
    target.load_state_dict(torch.load(stream, weights_only=True))
    assert decides(target).thresholds == chosen
    target.load_state_dict(without_settings(source.state_dict()))
    assert decides(target).thresholds == chosen
    target.load_state_dict(deciding_modules()[kind].state_dict())
    assert decides(target).thresholds is None


def observation_model(**settings):
    return FovealObservationModel.identity(["cup", "cat"], [0.2], **settings)


@pytest.mark.parametrize("part", ["log_cell", "presence.centre"])
def test_a_state_that_lacks_a_part_is_refused(part):
    presence = Presence(torch.tensor(1.5), torch.ones(2), torch.full((2,), 0.5), centre=torch.tensor([2.0, 0.5]))
    state = observation_model(presence=presence).state_dict()
    del state[part]
    with pytest.raises(RuntimeError, match=f"Missing key.*{part}"):
        observation_model(presence=presence).load_state_dict(state)


def test_a_part_that_the_module_lacks_is_refused():
    presence = Presence(torch.tensor(1.5), torch.ones(2), torch.full((2,), 0.5))
    rates = torch.full((3, 2), 0.1)
    for name, source in (
        ("presence.offset", observation_model(presence=presence)),
        ("miss_rate", observation_model(miss_rate=rates)),
    ):
        with pytest.raises(RuntimeError, match=f"Unexpected key.*{name}"):
            observation_model().load_state_dict(source.state_dict())
        observation_model().load_state_dict(source.state_dict(), strict=False)


def test_files_and_digests_hold_tensors_alone(tmp_path):
    for kind, name in ((Verification, "verification"), (FovealObservationModel, "observation")):
        files = sorted(kind.shipped.glob("*.safetensors"))
        model = kind.from_pretrained(files[0])
        model.save(tmp_path / f"{name}.safetensors")
        again = kind.from_pretrained(tmp_path / f"{name}.safetensors")
        assert again.digest() == model.digest()
        assert not [key for key in load_tensors((tmp_path / f"{name}.safetensors").read_bytes()) if "extra" in key]
    assert ActivePerception
