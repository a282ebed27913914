"""Search a photograph for a class by moving a fovea, and draw the scanpath.

Run it from a checkout: python -m examples.search_photograph PHOTO.jpg cup --out scanpath.png
"""

import argparse

import semfov
from semfov import viz


def main() -> None:
    """Search a photograph, or one that comes with semfov if none is given."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photo", nargs="?", help="image file (default: one that comes with semfov)")
    parser.add_argument("target", nargs="?", default="boat", help="class to search for (default: boat)")
    parser.add_argument("--out", default="scanpath.png", help="figure to write (default: scanpath.png)")
    arguments = parser.parse_args()

    # The agent consists of an eye (a sensor followed by a detector), an observer that turns looks into a belief, and a
    # policy that chooses where to look next. `.published` gives the agent of the paper; `semfov.ActivePerception(...)`
    # combines your own parts.
    agent = semfov.ActivePerception.recommended()

    image = semfov.read_image(arguments.photo) if arguments.photo else semfov.example("beach")
    scanpath = agent.search(image, arguments.target, start=0)

    for number, (x, y) in enumerate(scanpath.as_fixations("photograph").points.tolist(), 1):
        print(f"fixation {number} at ({x:.0f}, {y:.0f})")
    print(scanpath.describe())
    viz.save_figure(scanpath.plot(), arguments.out)


if __name__ == "__main__":
    main()
