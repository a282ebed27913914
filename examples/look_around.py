"""Explore a panorama by moving an eye and turning a head, or search it for a class, and draw the path of both.

Run it from a checkout: python -m examples.look_around PANORAMA.jpg cup --out head.png --film head.gif
"""

import argparse

import semfov
from semfov import HeadAgent
from semfov.head import Panoramas
from semfov.settings import ExploreSettings, SearchSettings


def main() -> None:
    """Look around in an equirectangular panorama, or in one made of embedded scenes if none is given."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("panorama", nargs="?", help="image file (default: embedded scenes on a sphere)")
    parser.add_argument("target", nargs="?", help="class to search for (default: explore)")
    parser.add_argument("--seconds", type=float, default=10.0, help="maximum duration (default: 10)")
    parser.add_argument("--out", default="head.png", help="figure to write (default: head.png)")
    parser.add_argument("--film", help="animation (GIF) to write (default: none)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the panorama of embedded scenes (default: 0)")
    arguments = parser.parse_args()

    agent = HeadAgent.recommended()
    if arguments.panorama:
        image = semfov.read_image(arguments.panorama)
    else:
        scenes = semfov.EmbeddedScenes(agent.classes[1:], count=12)
        image = Panoramas(scenes, width=2048, count=1, seed=arguments.seed)[0].image

    if arguments.target is None:
        path = agent.explore(semfov.Panorama(image), ExploreSettings(duration=arguments.seconds))
    else:
        path = agent.search(semfov.Panorama(image), arguments.target, SearchSettings(duration=arguments.seconds))

    for number, seconds in enumerate(path.seconds):
        yaw, pitch, _ = path.pose(number).tolist()
        x, y, z = path.gaze(number).tolist()
        print(f"{seconds:5.2f} s: head at yaw {yaw:.0f}°, pitch {pitch:.0f}°; gaze along ({x:.2f}, {y:.2f}, {z:.2f})")
    print(path)
    path.plot(image=image).savefig(arguments.out, dpi=88)
    if arguments.film:
        path.animate(arguments.film, image=image)


if __name__ == "__main__":
    main()
