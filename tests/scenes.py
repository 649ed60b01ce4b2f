"""Lines of example scenes, for tests."""

from typing import Any

from maplines_can import map_lines


def scene_lines(scene: Any, lines: int = 4, **settings: Any) -> Any:
    """Return the first lines of a scene as ``map_lines`` does, with its settings."""
    return map_lines(scene.lines[:lines], scene.ego, scene.window, **settings)
