"""What the evidence tools share: how they tell what they do and what they found."""

import sys

from tqdm import tqdm


def progress(steps, what):
    """The steps, with a bar where a person looks on."""
    return tqdm(steps, desc=what, disable=not sys.stderr.isatty())


def show(result, width, indent=0):
    """Names and figures, those of a group below its name."""
    for key, value in result.items():
        if isinstance(value, dict):
            print(" " * indent + f"{key}:")
            show(value, width, indent + 4)
        else:
            text = f"{value:.6g}" if isinstance(value, float) else value
            print(" " * indent + f"{key:<{width}}{text}")
