"""Computes the maps of all policies along the scanpaths of all people, picture by picture."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Annotated

import torch
from torch import Tensor
from torch.nn import functional as F

from eval.human.viewing.density import Events, enlarged, events_of
from semfov.belief.grid import Grid
from semfov.belief.observers import Landing, Look, Observer
from semfov.belief.observers.gathering import Gatherer
from semfov.data.classes import class_index
from semfov.data.fixations import Fixations, by_picture, read_osie, read_table
from semfov.data.pictures import Pictures
from semfov.data.scene import Scenes
from semfov.detection.detections import Detections
from semfov.detection.load import check_detector
from semfov.episode import Looks, Sight, Stopwatch, StoredLooks, rollout
from semfov.errors import DataError, InputError
from semfov.gaze.acquisition import Uniform
from semfov.gaze.choice import Given
from semfov.gaze.policies import ObjectSeeking, Task
from semfov.io.schema import Field, Schema
from semfov.runs.candidates import Candidate
from semfov.runs.config import PolicyConfig, RunConfig, SaliencyConfig, SaliencyModel
from semfov.runs.looks import one_thread
from semfov.runs.policy_looking import PolicyLooking
from semfov.runs.results import ResultRecord
from semfov.runs.saliency_store import SALIENCY_CLASSES
from semfov.runs.scene_run import digest_of, store_folder
from semfov.runs.settings import Count, Positive, Range, Seed, Settings, Side, Whole
from semfov.runs.store import SceneStore, looks_digest
from semfov.strategy import Strategy


@dataclass(frozen=True)
class PicturesConfig(Settings):
    """The pictures that people saw.

    Args:
        root: folder of the pictures.
        limit: use only this many pictures, the first ones.
    """

    root: Path = Path()
    limit: Count | None = None


@dataclass(frozen=True)
class DensityConfig(Settings):
    """How maps are turned into densities of the next fixation; all models have the same kinds of free parameters.

    Args:
        columns: number of columns of the raster; fixations are assigned to its bins.
        rows: number of rows of the raster.
        blurs: standard deviations, in bins, of Gaussian blurs; the best-fitting one is used.
        events: number of randomly drawn fixations on which the weights are fitted.
        seed: random seed of this draw.
    """

    columns: Side = 40
    rows: Side = 30
    blurs: tuple[Annotated[float, Range(0, 20)], ...] = (0.0, 1.0, 2.0)
    events: Count = 4000
    seed: Seed = 0


@dataclass(frozen=True)
class ViewingConfig(RunConfig):
    """Comparison of people and policies that view the same pictures without a task.

    Args:
        people: fixations of all people: the JSON file of OSIE, or a table (`.csv`) as `semfov.data.fixations` reads it.
        data: the pictures.
        belief: the belief of the policies; looks are taken from the centres of its cells.
        saliency: settings of the saliency maps that policies have as priors.
        protocol: the protocol; its seed draws the scanpaths.
        density: how maps are turned into densities.
        policies: exploration policies, by preset or settings (`python -m eval.explore --help`). The policy `landing`,
            on the cells of the raster, is always included.
        models: saliency models.
        swap: exchange the two halves of the pictures: report on the half that is otherwise used for fitting.
        sequences: models whose scanpaths are drawn and compared with those of people.
        files: scanpaths of other models in these pictures, as tables (`.csv`), to compare with those of people.
        drawings: number of pictures for which scanpaths of people and of `landing` are shown side by side.
        bandwidth: bandwidth of the clusters of fixations that make up the letters of a sequence, as a fraction of the
            picture's longer side.
        longest: number of fixations of a scanpath that are used, the first ones.
        out: folder for tables, figures and the manifest.
        cache: folder for the stored detections from every cell and for maps (None: the user's cache).
        store: keep detections and maps on disk; false computes them anew in each run.
    """

    people: Path = Path("fixations.json")
    data: PicturesConfig = field(default_factory=PicturesConfig)  # type: ignore[assignment]
    saliency: SaliencyConfig = field(default_factory=lambda: SaliencyConfig(view="picture"))
    density: DensityConfig = field(default_factory=DensityConfig)
    policies: tuple[str | PolicyConfig, ...] = (
        "kl-calibrated",
        "negative-entropy-calibrated",
        "two-peaks-calibrated",
        "surprise-calibrated",
        "closer-look-learned",
        "expected-gain-learned",
        "objects-calibrated",
    )
    models: tuple[SaliencyModel, ...] = ("vocus2", "itti-koch")  # type: ignore[assignment]
    swap: bool = False
    sequences: tuple[str, ...] = ("random", "centre bias", "nearby", "vocus2", "kl-calibrated", "landing")
    files: tuple[Path, ...] = ()
    drawings: Whole = 2
    bandwidth: Positive = 0.08
    longest: Annotated[int, Range(2, 1000)] = 20
    out: Path = Path("runs/human_viewing")


_SOURCES = ("semfov.runs.candidates", "semfov.gaze.policies", "semfov.gaze.saliency", "semfov.episode", __name__)
"""Modules that the maps depend on, in addition to those of a look."""


def map_store(folder: Path, what: Mapping[str, object], cells: int) -> SceneStore:
    """A store of the values of all cells after each fixation of all people, by the settings that they depend on."""
    return SceneStore(folder, what, looks_digest(*_SOURCES), Schema({"values": Field(("E", cells))}))


class FineLooks(Looks):
    """Looks from the centres of coarse cells, for a belief about finer cells.

    Args:
        detections: detections from every coarse cell, as a batch.
        grid: the grid of coarse cells.
        fine: the grid of the belief.
    """

    def __init__(self, detections: Detections, grid: Grid, fine: Grid) -> None:
        self.detections, self.coarse, self.grid = detections, grid, fine
        self.like = detections.scores
        self._weighed: tuple[Observer, Look] | None = None

    def see(self, observer: Observer, episodes: Tensor, cell: Tensor, fixation: Tensor) -> Sight:
        """The look from the coarse cell in which the centre of each fine cell lies."""
        if self._weighed is None or self._weighed[0] is not observer:
            centres = self.coarse.centres.to(self.like)
            self._weighed = observer, observer.weigh(self.detections, centres, self.grid)
        row = self.coarse.cell_of(self.grid.centres[cell])
        return Sight(self._weighed[1][row], lambda: self.detections[row], Stopwatch().seconds)


def evaluate_along(looks: Looks, candidates: Mapping[str, Candidate], scanpaths: Sequence[Tensor]) -> dict[str, Tensor]:
    """Evaluate policies along given scanpaths.

    The scanpaths are given, so policies with the same kind of observer have the same belief: one rollout serves them
    all.

    Args:
        looks: the looks at the picture.
        candidates: policies by name; their observers have the same settings.
        scanpaths: for each scanpath `(n,)`, the fixated cells.

    Returns:
        For each policy `(E, X·Y)`, the values of the cells after each fixation except the last of each scanpath, one
        scanpath after the other.
    """
    longest = max(map(len, scanpaths))
    padded = torch.stack([torch.cat([path, path[-1:].expand(longest - len(path))]) for path in scanpaths])
    observer = next(iter(candidates.values())).observer
    if isinstance(observer, Gatherer):
        # The batch always consists of all people, so the bits of the result never change.
        observer.together = True
    tables: dict[str, list[Tensor]] = {name: [] for name in candidates}
    most = max(longest - 1, 1)
    for step in rollout(looks, observer, Uniform(), padded[:, 0], Given(padded), most=most):
        for name, candidate in candidates.items():
            tables[name].append(candidate.acquisition(None, looks.grid, step.cell)(step.belief, step.visited))
    rows = [(person, len(path) - 1) for person, path in enumerate(scanpaths)]
    stacked = {name: torch.stack(values, 1) for name, values in tables.items()}
    return {name: torch.cat([table[person, :count] for person, count in rows]) for name, table in stacked.items()}


LANDING = "landing"
"""The exploration policy `objects` with a `Landing` observer, on the cells of the raster."""


def read_people(path: Path) -> list[Fixations]:
    """Read the fixations of all people from the JSON file of OSIE or from a table."""
    return read_table(path) if path.suffix == ".csv" else read_osie(path)


class ViewingRun(PolicyLooking):
    """Free viewing, one picture after the other: computes the maps of policies along people's scanpaths."""

    task: Task = "exploration"
    config: ViewingConfig

    def __init__(self, config: ViewingConfig) -> None:
        super().__init__(config)
        cells, bins = len(self.grid(0)), config.density.columns * config.density.rows
        cache, common = store_folder(config.cache) / "viewing", self._what()
        beliefs = {name: asdict(policy) for name, policy in self.policies.items()}
        self.map_stores = {
            name: map_store(cache, {**common, "policy": policy}, cells) for name, policy in beliefs.items()
        }
        self.map_stores[LANDING] = map_store(cache, {**common, "policy": LANDING, "bins": bins}, bins)
        for name in config.models:
            self.map_stores[name] = map_store(cache, {"saliency": name, "raster": self._raster_size}, bins)

    def check_sources(self) -> None:
        """Check that the detector exists; pictures are looked for after people's files have been read."""
        check_detector(self.config.detector.name)

    def open_scenes(self) -> Scenes:
        """The pictures that people saw and that are found in the folder."""
        data = self.config.data
        self.people = by_picture(each for each in read_people(self.config.people) if len(each) > 1)
        if data.limit is not None:
            self.people = dict(list(self.people.items())[: data.limit])
        return Pictures(data.root, self.people, self.eye.detector.classes)

    @property
    def _raster_size(self) -> list[int]:
        return [self.config.density.columns, self.config.density.rows]

    def _what(self) -> dict[str, object]:
        """Settings that the maps of all pictures and policies depend on."""
        grid = [self.config.belief.columns, self.config.belief.rows]
        fitted = digest_of([self.models.observation, self.models.map])
        belief = {name: value for name, value in asdict(self.config.belief).items() if not name.endswith("model")}
        eye = {"eye": self.eye.settings(), "grid": grid, "belief": belief, "fitted": fitted}
        return {**eye, "longest": self.config.longest}

    def _followed(self, index: int) -> str:
        """sha256 of a picture and of the scanpaths in it."""
        paths = [each.points.tolist() for each in self.people[str(self.scenes.ids[index])]]
        return hashlib.sha256(json.dumps([self.digest(index), paths]).encode()).hexdigest()

    @property
    def names(self) -> list[str]:
        """Names of all maps: of policies, of `landing` and of saliency models."""
        return list(self.map_stores)

    @cached_property
    def landing(self) -> Candidate:
        """The policy `landing`."""
        classes = self.scenes.classes
        try:
            person = class_index("person", classes)
        except InputError:
            person = None
        return Candidate(Strategy(Landing(len(classes), person), ObjectSeeking()))

    def raster(self, index: int) -> Grid:
        """The raster of a picture."""
        density = self.config.density
        return Grid(density.columns, density.rows, self.scenes.annotation(index).size)

    def events(self, index: int) -> Events:
        """The fixations of a picture that are to be predicted."""
        people = self.people[str(self.scenes.ids[index])]
        size = self.scenes.annotation(index).size
        for each in people:
            if each.size != size:
                raise DataError(
                    f"people: expected fixations in {each.picture} for a picture size of {size}, as in its file, got "
                    f"{each.size}; check data.root"
                )
        return events_of(people, self.raster(index), self.grid(index), self.config.longest)

    def candidate(self, name: str, index: int) -> Candidate:
        """The policy of this name in tables, for a picture."""
        return self.landing if name == LANDING else super().candidate(name, index)

    def looks(self, name: str, index: int) -> Looks:
        """The looks of a policy at a picture."""
        detections, grid = self.detections(index), self.grid(index)
        return FineLooks(detections, grid, self.raster(index)) if name == LANDING else StoredLooks(detections, grid)

    def values(self, name: str, index: int) -> Tensor:
        """Values of the cells of a picture, read from the store, or computed and stored.

        Policies with the same observer settings are evaluated together.

        Args:
            name: name of a policy or of a saliency model.
            index: index of the picture.

        Returns:
            `(E, X·Y)`, the values after each fixation of all people, or `(1, bins)` for a saliency model.
        """
        digest = self._followed(index)
        tensors = self.map_stores[name].read(digest) if self.config.store else None
        if tensors is not None:
            return tensors["values"]
        with one_thread(), torch.inference_mode():
            if name in SALIENCY_CLASSES:
                saliency = SALIENCY_CLASSES[name]()(self.scenes[index].image[None])
                columns, rows = self._raster_size
                maps = {name: F.adaptive_avg_pool2d(saliency, (rows, columns)).flatten(1)}
            else:
                events = self.events(index)
                paths = events.fine if name == LANDING else events.cells
                alike = {each: self.candidate(each, index) for each in self._alike(name)}
                maps = evaluate_along(self.looks(name, index), alike, paths)
        if self.config.store:
            for each, values in maps.items():
                self.map_stores[each].write(digest, {"values": values.float().contiguous()})
        return maps[name].float()

    def _alike(self, name: str) -> list[str]:
        """The policies with the same observer settings as this one, including itself."""
        if name == LANDING:
            return [name]

        def observing(policy: PolicyConfig) -> object:
            return policy.scores, policy.tempering, policy.footprint, policy.memory, policy.misses

        own = observing(self.policies[name])
        return [each for each, policy in self.policies.items() if observing(policy) == own]

    def maps(self, name: str, index: int) -> Tensor:
        """The values as maps `(E, H, W)` or `(1, H, W)` over the bins."""
        values, (columns, rows) = self.values(name, index), self._raster_size
        fine = values.shape[-1] == columns * rows
        return enlarged(values, self.raster(index) if fine else self.grid(index), rows, columns)

    def outcomes(self, index: int) -> tuple[list[ResultRecord], dict[str, float]]:
        """Compute all maps of a picture; returns its number of events, and the seconds that each stage took."""
        watch = Stopwatch()
        self.detections(index)
        watch.lap("look")
        for name in self.names:
            self.values(name, index)
            watch.lap(name)
        return [{"picture": self.scenes.ids[index], "events": len(self.events(index))}], watch.seconds
