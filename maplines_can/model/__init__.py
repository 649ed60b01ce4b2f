"""Model of the core: the rules of ``dbc/README.md``, one function each, in plain numbers.

It is for people: to study a record step by step, to port the project to another language, and as
the witness of the core in C. The product never calls it; ``maplines selftest`` compares both on the
machine at hand, to the last bit. All numbers are floats and ints, all matrices lists of rows
(``matrices.py``), and nothing is written for speed. Reasons, statuses and states are strings: the
names of those of the product.

It may import the types of lines, ``values.errors``, ``values.line`` and ``values.scene``, and what
a DBC says, ``wire.layout``. Read the receiver in this order::

    elementary.py    functions with the same bits on any machine
    signals.py       bits of a signal to a raw value and back; raw values to physical ones
    records.py       a record from its signals: pages, transfer ID, checksum; what no sender sends
    secoc.py         is a frame authentic
    reassembly.py    the pages of a transfer, or none
    e2e.py           checksum, status of a counter, state machine
    sequence.py      is a record new; lost, late and repeated ones; a sender that restarts
    senders.py       signs of a second sender
    mixtures.py      the components of a line, or none; their weights
    epochs.py        which lines belong to which pose error
    lines.py         cubics seen from another pose
    levels.py        line-specific covariance of levels
    scenes.py        lines and joint covariance from the pose error and the records of the lines
    whole_scenes.py  records of whole scenes; which of them are of one scene
    settings.py      time-outs and cycle times
    decoder.py       all of it: class ``Receiver``

the sender, which shares some of them, since it decodes what it has encoded::

    covariance.py    a covariance as pivots, ratios and an inflation that covers it
    nearest_line.py  the line within the ranges of a message that is nearest to another one
    writer.py        a line, or a mixture, as complete records
    joint.py         what two joint covariances lack to cover a third
    level_search.py  which levels of the line-specific covariance tell the least wrong
    places.py        which place of the records of whole scenes each line has
    scene_sender.py  a scene as records

and the propagation, from map lines and an uncertain pose to lines with covariances::

    stretches.py     what a car sees of a line, as a function y(x) in its frame
    cubic_ranges.py  the longest range in which a cubic follows a line, and what it misses there
    refits.py        the cubic that a line is, as a function of the pose; errors of the map
    certain_range.py where the lateral position of a line is known well enough
    propagation.py   moments over the pose: lines one by one, and scenes
"""
