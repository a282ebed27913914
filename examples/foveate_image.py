"""See a photograph as an eye does: sharp at the fixation, and increasingly blurred around it.

Run it from a checkout: python -m examples.foveate_image PHOTO.jpg --gaze 200 300 --out foveated.png
"""

import argparse

from PIL import Image

import semfov


def main() -> None:
    """Foveate a photograph, or one that comes with semfov if none is given."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("photo", nargs="?", help="image file (default: one that comes with semfov)")
    parser.add_argument(
        "--gaze", nargs=2, type=float, metavar=("X", "Y"), help="fixation in pixels (default: the centre)"
    )
    parser.add_argument("--sigma", type=float, default=100.0, help="width of the fovea in pixels (default: 100)")
    parser.add_argument("--out", default="foveated.png", help="file to write (default: foveated.png)")
    arguments = parser.parse_args()

    image = semfov.read_image(arguments.photo) if arguments.photo else semfov.example("beach")
    height, width = image.shape[-2:]
    gaze = image.new_tensor(arguments.gaze or ((width - 1) / 2, (height - 1) / 2))

    # A batch of one image and one gaze. The module `semfov.Foveation` does the same for many gazes at one image.
    foveated = semfov.foveate(image[None], gaze[None], sigma=arguments.sigma)[0]

    pixels = (foveated.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).numpy()
    Image.fromarray(pixels).save(arguments.out)
    print(f"{arguments.out}: {width} × {height} pixels, sharp at ({gaze[0]:.0f}, {gaze[1]:.0f})")


if __name__ == "__main__":
    main()
