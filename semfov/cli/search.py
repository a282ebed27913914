"""Subcommands that look at pictures: search, find and explore."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

from semfov.agent import PictureLike
from semfov.cli.agent import check_target, known_classes, make_agent, several_classes
from semfov.cli.episodes import PictureSource, look_at_pictures, picture_sources, start_beside
from semfov.cli.options import ExploreOptions, FindOptions, PictureOptions, SearchOptions, start_of
from semfov.cli.results import kind_of
from semfov.data.classes import class_index
from semfov.data.word_vectors import WordVectors, spread
from semfov.errors import InputError, check
from semfov.paths import GazeRecord


def search_pictures(options: SearchOptions) -> int:
    """Search pictures for a class.

    Args:
        options: the options.

    Returns:
        The exit code.
    """
    check_target(options.target, options)
    start = _check(options)
    known = known_classes(options)
    wanted = None if known is None else meant(options, known)
    agent = make_agent(options)
    wanted = meant(options, agent.classes[1:]) if wanted is None else wanted
    target = next(iter(wanted))
    given: dict[str, Any] = {name: getattr(options, name) for name in ("confirm", "give_up", "closer", "seed")}

    def look(picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> GazeRecord:
        kind = agent.kind_of_look(picture, shared["how"])
        if kind != "fovea":
            only_likeliest(wanted)
        aim = wanted if kind == "fovea" and len(wanted) > 1 else target
        first = start if start is not None or kind != "fovea" else start_beside(agent, source, options.seed)
        return agent.search(picture, aim, start=first, **given, **shared)

    return look_at_pictures(options, agent, look, f"search for “{target}”", target)


def find_objects(options: FindOptions) -> int:
    """Find all objects in pictures.

    Args:
        options: the options.

    Returns:
        The exit code.

    Raises:
        InputError: an option does not fit.
    """
    if options.start is not None:
        raise InputError(f"start: expected none for find, which begins with the whole picture, got {options.start!r}")
    _check(options)
    targets = several_classes(options.target, known_classes(options))
    agent = make_agent(options)
    targets = several_classes(options.target, agent.classes[1:])
    given: dict[str, Any] = {"worth": options.worth, "batch": options.batch}

    def look(picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> GazeRecord:
        return agent.find_all(picture, targets, **given, **shared)

    first = None if targets is None else targets[0]
    return look_at_pictures(options, agent, look, f"all {' and '.join(targets or ['objects'])}", first)


def explore_pictures(options: ExploreOptions) -> int:
    """Explore pictures.

    Args:
        options: the options.

    Returns:
        The exit code.
    """
    start = _check(options)
    known_classes(options)
    agent = make_agent(options)

    def look(picture: PictureLike, shared: dict[str, Any], source: PictureSource) -> GazeRecord:
        return agent.explore(picture, start=start, seed=options.seed, worth=options.worth, **shared)

    return look_at_pictures(options, agent, look, "exploration")


def _check(options: PictureOptions) -> Any:
    """Check what can be checked before anything is loaded; returns the first cell."""
    picture_sources(options)
    if options.out is not None:
        kind_of(options.out)
    check(not options.draw or options.out is not None, "draw", "--out FOLDER beside --draw", "none")
    return start_of(options.start)


def meant(options: SearchOptions, classes: tuple[str, ...]) -> dict[str, float]:
    """The classes that a target may mean, each with a weight, the most likely first.

    Args:
        options: the options.
        classes: names of the detector's classes.

    Returns:
        Weights by class.

    Raises:
        InputError: the target is no class, and there are no word vectors, or they do not help.
    """
    target = options.target or ""
    try:
        return {classes[class_index(target, classes, "target") - 1]: 1.0}
    except InputError as error:
        if options.embeddings is None:
            raise InputError(f"{error}{_other_ways(target, classes, str(error))}") from None
    vectors = WordVectors.read(options.embeddings, [target, *classes])
    found = spread(target, classes, vectors)
    print(f"“{target}” may mean: {', '.join(f'{name} {weight:.2f}' for name, weight in found.items())}")
    if vectors.missing:
        print(f"  words without a vector in {options.embeddings}: {', '.join(vectors.missing)}")
    return found


def _other_ways(target: str, classes: tuple[str, ...], refused: str) -> str:
    """What else a target that is no class can be, after the message that refuses it."""
    names = target.split(",")
    with suppress(InputError):
        if len([class_index(name.strip(), classes) for name in names]) > 1:
            return "; a search is for one class, and `semfov find` takes several"
    return "" if "did you mean" in refused else "; a description needs --embeddings, a file of word vectors"


def only_likeliest(wanted: dict[str, float]) -> None:
    """Say so if only the most likely class of a description is searched for."""
    if len(wanted) > 1:
        print(f"large pictures and scenes are searched only for the most likely class: {next(iter(wanted))}")
