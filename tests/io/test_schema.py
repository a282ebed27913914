"""Files of models: errors name invalid fields even if the checksum is right; valid models load bit-identically."""

import json

import pytest
import torch
from safetensors.torch import save_file

from semfov import DataError, DirichletStatistics, FovealObservationModel, InputError
from semfov.belief import Verification
from semfov.io import storage
from semfov.io.pretrained import PretrainedForEye
from semfov.io.schema import Array, Field, Flag, Maybe, Number, Object, Schema, Text, is_number, is_plain
from semfov.io.storage import read_tensors, write_tensors
from semfov.observation.presence import Presence
from semfov.observation.thresholds import Thresholds
from semfov.zoom import GlimpseEvidence
from tests.refusals import refused, unusable

CLASSES = ["cup", "cat"]
METADATA = {"detector": {"name": "toy", "digest": "1"}, "sensor": {}}


def observation():
    settings = {"expected": torch.full((3, 2, 3), 1 / 3), "miss_rate": torch.full((3, 2), 0.25), "tempering": 0.5}
    return FovealObservationModel.identity(CLASSES, [0.2], **settings)


def searching():
    numbers = torch.tensor(-0.5), torch.tensor([0.75, 0.125]), torch.tensor([0.25, 0.5])
    presence = Presence(*numbers, Thresholds(0.83, 0.05), centre=torch.tensor([1.5, 0.75]))
    odds = torch.full((3, 2), 0.125)
    return FovealObservationModel.identity(CLASSES, [0.2], miss_odds=odds, refutation=0.5, presence=presence)


def glimpses():
    return GlimpseEvidence(3, foresight=0.25, places=Thresholds(0.7, 0.3, 0.2))


def verification():
    return Verification(thresholds=Thresholds(0.7, 0.3, 0.2), metadata=METADATA)


def seeded(make):
    """The same model whenever it is made, with random numbers also where a new model has zeros."""

    def made():
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            model = make()
            for name, tensor in model.state_dict().items():
                if name in ("prior", "linear.bias"):
                    tensor.normal_()
            return model

    return made


EVERY = (observation, searching, glimpses, verification)
MODELS = {make.__name__: seeded(make) for make in EVERY}
LOADERS = {name: type(make()) for name, make in MODELS.items()}


def parts(model):
    """Tensors and record of a model, as written to a file."""
    record = {"kind": model.kind, "version": "0", **model._record(), "metadata": model.metadata}
    return dict(model._tensors()), json.loads(json.dumps(record))


def message_of_refused_file(name, tmp_path, tensors, record):
    path = tmp_path / "model.safetensors"
    storage.write_file(path, tensors, record)
    with pytest.raises(DataError) as caught:
        LOADERS[name].from_pretrained(path)
    message = str(caught.value)
    assert message.startswith(str(path))
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", MODELS)
def test_saved_models_load_bit_identically(name, tmp_path):
    model, path = MODELS[name](), tmp_path / "model.safetensors"
    model.save(path)
    whole = path.read_bytes()
    again = LOADERS[name].from_pretrained(path)
    assert not again.training
    assert {k: v.tolist() for k, v in again.state_dict().items()} == {
        k: v.tolist() for k, v in model.state_dict().items()
    }
    assert again._record() == json.loads(json.dumps(model._record())) or again._record() == model._record()
    assert (again.metadata, again.digest()) == (model.metadata, model.digest())
    again.save(path)
    assert path.read_bytes() == whole
    assert [each.name for each in tmp_path.iterdir()] == ["model.safetensors"]


@pytest.mark.parametrize("name", MODELS)
def test_missing_damaged_and_other_files_are_refused(name, tmp_path):
    path, other = tmp_path / "model.safetensors", tmp_path / "other.safetensors"
    unusable(r"model\.safetensors: no such file", LOADERS[name].from_pretrained, path)
    MODELS[name]().save(path)
    whole = path.read_bytes()
    for damaged in (b"no", whole[:-40]):
        path.write_bytes(damaged)
        unusable(r"model\.safetensors: not a readable", LOADERS[name].from_pretrained, path)
    DirichletStatistics((2,), 3).save(other)
    with pytest.raises(DataError, match=f"expected a file of kind {LOADERS[name].kind}, got dirichlet-statistics"):
        LOADERS[name].from_pretrained(other)


@pytest.mark.parametrize("name", MODELS)
def test_shipped_models_are_found_by_name(name, tmp_path, monkeypatch):
    monkeypatch.setattr(LOADERS[name], "shipped", tmp_path)
    MODELS[name]().save(tmp_path / "toy-tiny.safetensors")
    assert LOADERS[name].from_pretrained("toy-tiny").digest() == MODELS[name]().digest()
    assert LOADERS[name].if_shipped("no such model") is None
    refused("did you mean 'toy-tiny'", LOADERS[name].from_pretrained, "toy-tyni")


@pytest.mark.parametrize("name", [name for name, kind in LOADERS.items() if issubclass(kind, PretrainedForEye)])
def test_models_of_an_eye_refuse_another_detector(name):
    model = MODELS[name]()
    model.check_compatible(METADATA)
    with pytest.raises(InputError, match=f"{model.title}.*fitted for 'toy'"):
        model.check_compatible({"detector": {"name": "other", "digest": "2"}, "sensor": {}})


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_tensors_with_nan_or_infinity_are_refused(name, value, tmp_path):
    for key in parts(MODELS[name]())[0]:
        tensors, record = parts(MODELS[name]())
        spoiled = tensors[key].detach().clone()
        spoiled.view(-1)[-1] = value
        assert f"{key}: expected finite numbers" in message_of_refused_file(
            name, tmp_path, {**tensors, key: spoiled}, record
        )


@pytest.mark.parametrize("name", MODELS)
def test_missing_tensors_and_tensors_of_another_shape_or_type_are_refused(name, tmp_path):
    optional = {key for key, each in LOADERS[name].schema.tensors.items() if each.optional}
    for key in parts(MODELS[name]())[0]:
        tensors, record = parts(MODELS[name]())
        whole = tensors.pop(key).detach()
        if key not in optional:
            assert f"{key}: expected a tensor, got nothing" in message_of_refused_file(name, tmp_path, tensors, record)
        for other in (torch.int64, torch.bool, torch.bfloat16, torch.uint8):
            assert key in message_of_refused_file(name, tmp_path, {**tensors, key: whole.to(other)}, record)
        if whole.dtype == torch.float32:
            assert "type" in message_of_refused_file(name, tmp_path, {**tensors, key: whole.double()}, record)
        for other in (whole[None], whole.new_zeros(0), torch.cat([whole, whole[:1]]) if whole.ndim else whole[None]):
            message_of_refused_file(name, tmp_path, {**tensors, key: other.clone()}, record)
    tensors, record = parts(MODELS[name]())
    assert "surplus" in message_of_refused_file(name, tmp_path, {**tensors, "surplus": torch.zeros(1)}, record)


JUNK = [None, True, "x", -1, 0.5, 10**400, [], {}, [None], {"a": 1}, [[1, 2], [3, 4]], "\0", ["cup", "cup"], 10**9]


@pytest.mark.parametrize("name", MODELS)
def test_invalid_values_in_records_are_refused_and_valid_ones_are_loaded(name, tmp_path):
    """For every field and value: the file is refused, or the loaded model has that value."""
    for key in parts(MODELS[name]())[1]:
        tensors, record = parts(MODELS[name]())
        if key in ("kind", "metadata", "version"):
            continue
        del record[key]
        missing = loaded_or_none(name, tmp_path, tensors, record)
        assert missing is None or key in ("thresholds", "places", "certainty", "photograph")
        for junk in JUNK:
            tensors, record = parts(MODELS[name]())
            loaded = loaded_or_none(name, tmp_path, tensors, {**record, key: junk})
            if loaded is not None:
                assert json.loads(json.dumps(loaded._record()))[key] == junk
    tensors, record = parts(MODELS[name]())
    assert loaded_or_none(name, tmp_path, tensors, {**record, "surplus": 1}) is None
    for metadata in (None, 1, [], "x", {"detector": 1}, {"sensor": []}, {"detector": "x"}):
        assert "metadata" in message_of_refused_file(name, tmp_path, tensors, {**record, "metadata": metadata})


def loaded_or_none(name, tmp_path, tensors, record):
    path = tmp_path / "model.safetensors"
    storage.write_file(path, tensors, record)
    try:
        return LOADERS[name].from_pretrained(path)
    except DataError:
        return None


@pytest.mark.parametrize(
    ("key", "value", "told"),
    [
        ("tempering", 0.0, "above 0"),
        ("tempering", -1.0, "above 0"),
        ("tempering", 1e9, "up to 100"),
        ("miss_rate", 1.5, "from 0 to 1"),
        ("miss_rate", -0.1, "from 0 to 1"),
        ("expected", 0.9, "sum to 1"),
        ("edges", -0.1, "above 0"),
        ("log_alpha", 500.0, "from -30 to 30"),
    ],
)
def test_fields_of_an_observation_model_out_of_range_are_refused(key, value, told, tmp_path):
    tensors, record = parts(observation())
    message = message_of_refused_file(
        "observation", tmp_path, {**tensors, key: torch.full_like(tensors[key], value)}, record
    )
    assert f"{key}: expected" in message
    assert told in message


def test_an_observation_model_is_also_checked_when_it_is_constructed():
    for wrong in ({"tempering": float("nan")}, {"tempering": float("inf")}, {"miss_rate": torch.full((3, 2), 2.0)}):
        refused(f"^{next(iter(wrong))}: ", FovealObservationModel.identity, CLASSES, [0.2], **wrong)


def test_files_without_a_checksum_or_with_odd_headers_are_refused(tmp_path):
    tensors, record = parts(observation())
    path = tmp_path / "model.safetensors"
    save_file({k: v.detach().contiguous() for k, v in tensors.items()}, path, {"semfov": json.dumps(record)})
    with pytest.raises(DataError, match="expected a file with the sha256 of its content, got one without"):
        FovealObservationModel.from_pretrained(path)
    for text in ["[" * 100_000, '{"a":' * 100_000, "NaN", '{"kind": Infinity}', "1", "[]", "null", ""]:
        path = tmp_path / "model.safetensors"
        save_file({"a": torch.zeros(1)}, path, {"semfov": text})
        unusable(r"model\.safetensors: (not a readable|expected)", FovealObservationModel.from_pretrained, path)
        assert read_tensors(path, "key") is None
    tensors, record = parts(observation())
    deep = "[" * 5000 + "]" * 5000
    text = json.dumps({**record, "sha256": "0" * 64}).replace('"metadata": {}', f'"metadata": {{"x": {deep}}}')
    path = tmp_path / "model.safetensors"
    save_file({k: v.detach().contiguous() for k, v in tensors.items()}, path, {"semfov": text})
    unusable(".", FovealObservationModel.from_pretrained, path)


def test_statistics_out_of_range_are_refused(tmp_path):
    statistics = DirichletStatistics((2,), 3).update(torch.tensor([[0.2, 0.3, 0.5]]), torch.tensor([1]))
    path = tmp_path / "statistics.safetensors"
    statistics.save(path)
    assert DirichletStatistics.load(path)[0] == statistics
    tensors, record = storage.read(path, "dirichlet-statistics")
    wrong = [
        ({**tensors, "count": -tensors["count"]}, record),
        ({**tensors, "count": tensors["count"].double()}, record),
        ({**tensors, "sums": tensors["sums"].float()}, record),
        (tensors, {**record, "epsilon": 0}),
        (tensors, {**record, "epsilon": None}),
        (tensors, {key: value for key, value in record.items() if key != "epsilon"}),
        ({**tensors, "more": torch.zeros(1)}, record),
    ]
    for content in wrong:
        storage.write_file(path, *content)
        unusable(".", DirichletStatistics.load, path)


def test_cached_tensors_of_another_schema_count_as_missing(tmp_path):
    schema = Schema({"a": Field(("M", 4)), "n": Field(("M",), torch.int64, low=0)})
    path = tmp_path / "x.safetensors"
    whole = {"a": torch.zeros(3, 4), "n": torch.arange(3)}
    write_tensors(path, "key", whole)
    assert read_tensors(path, "key", schema).keys() == whole.keys()
    for wrong in (
        {**whole, "a": whole["a"].bfloat16()},
        {**whole, "a": torch.full((3, 4), torch.nan)},
        {**whole, "n": torch.arange(4)},
        {**whole, "n": -torch.arange(3)},
        {"a": whole["a"]},
        {},
    ):
        write_tensors(path, "key", wrong)
        assert read_tensors(path, "key", schema) is None


def test_schemas_accept_valid_values_and_refuse_invalid_ones():
    sizes = {}
    Array(Text(), "K").check("classes", ["a", "b"], sizes)
    assert sizes == {"K": 2}
    Field(("K+1", "N-1")).check("t", torch.zeros(3, 4), sizes)
    assert sizes == {"K": 2, "N": 5}
    Schema({}, {"x": Flag(), "y": Number(low=0, whole=True)}).check({}, {"x": False, "y": 0})
    wrong = [
        (Number(0, 1), 2),
        (Number(size="K"), 0),
        (Number(), True),
        (Number(), float("nan")),
        (Array(Number(), ascending=True), [1, 1]),
        (Array((Number(), Number())), [1]),
        (Text(("a",)), "b"),
        (Object({"a": Number()}), {"b": 1}),
        (Object({"a": Number()}, required=("a",)), {}),
        (Maybe(Number()), "x"),
        *((Flag(), value) for value in (0, 1, None, "true")),
        *((Number(low=0, whole=True), value) for value in (1.0, -1, True, None)),
    ]
    for kind, value in wrong:
        refused(r"^name", kind.check, "name", value, {})
    assert not is_number(10**400)
    assert not is_plain("\x85")


def test_types_and_infinities_are_mixed_only_where_the_field_allows_it():
    mixed = {"a": torch.zeros(2), "b": torch.zeros(2, dtype=torch.float64)}
    Schema({name: Field((2,), mixed=True) for name in mixed}).check(mixed)
    Schema({"a": Field((2,), mixed=True), "b": Field((2,))}).check(mixed)
    refused("one floating-point type", Schema({name: Field((2,)) for name in mixed}).check, mixed)
    with pytest.raises(InputError, match=r"a: expected torch\.float32 or torch\.float64"):
        Schema({"a": Field((2,), mixed=True)}).check({"a": torch.zeros(2, dtype=torch.int64)})
    tensor = torch.tensor([-torch.inf, torch.nan])
    Schema({"a": Field((2,), finite=False)}).check({"a": tensor})
    refused("finite", Schema({"a": Field((2,))}).check, {"a": tensor})
