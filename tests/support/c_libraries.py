"""Libraries in C that lack features."""

from maplines_can.generation.c_build import ALL, Features

SMALL = Features(sender=False, scenes=False, mixtures=False, secoc=False, slots=4)
#: DBC and features of each library.
LIBRARIES = {
    "all": ("maplines.dbc", ALL),
    "conditional": ("maplines-pose.dbc", ALL),
    "receiver": ("maplines.dbc", Features(sender=False)),
    "sender": ("maplines.dbc", Features(receiver=False)),
    "sender of lines": ("maplines.dbc", Features(receiver=False, scenes=False, mixtures=False)),
    "no secoc": ("maplines-secoc.dbc", Features(secoc=False)),
    "no mixtures": ("maplines.dbc", Features(sender=False, mixtures=False)),
    "two slots": ("maplines-pose.dbc", Features(sender=False, slots=2)),
    "small": ("maplines.dbc", SMALL),
    "small, float": ("maplines.dbc", SMALL._replace(single=True)),
    "scenes": ("maplines-scene.dbc", ALL),
    "scenes, receiver": ("maplines-scene.dbc", Features(sender=False)),
    "scenes, small": ("maplines-scene.dbc", SMALL._replace(scenes=True)),
    "scenes, float": ("maplines-scene.dbc", Features(sender=False, single=True)),
    "scenes, sender": ("maplines-scene.dbc", Features(receiver=False)),
    "one slot": ("maplines.dbc", SMALL._replace(slots=1)),
}  # fmt: skip
