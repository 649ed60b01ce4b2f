"""What the tools share: how they are asked, and how they tell what they do and what they found."""

import argparse
import json
import sys

from tqdm import tqdm


def parser_of(doc):
    """A parser whose help is the head of the tool, as it is laid out there."""
    return argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )


def bar(total, what=None, **look):
    """A bar where a person looks on, moved by hand."""
    return tqdm(desc=what, total=total, disable=not sys.stderr.isatty(), **look)


def progress(steps, what, total=None):
    """The steps, with a bar where a person looks on."""
    return tqdm(steps, desc=what, total=total, disable=not sys.stderr.isatty())


def ended(result, as_json, width):
    """Print what was found; returns the exit status, by whether it is met."""
    if as_json:
        print(json.dumps(result, indent=2))
    else:
        show(result, width)
    return 0 if result["met"] else 1


def show(result, width, indent=0):
    """Names and figures, those of a group below its name."""
    for key, value in result.items():
        if isinstance(value, dict):
            print(" " * indent + f"{key}:")
            show(value, width, indent + 4)
        else:
            text = f"{value:.6g}" if isinstance(value, float) else value
            print(" " * indent + f"{key:<{width}}{text}")


def filled(page, tool, tables):
    """A page of docs with each table, by name, between the marks that say who writes it."""
    for name, table in tables.items():
        begin, end = f"<!-- {name}: written by tools/{tool} -->\n", f"\n<!-- end of {name} -->"
        before, rest = page.split(begin)
        page = f"{before}{begin}{table}{end}{rest.split(end)[1]}"
    return page
