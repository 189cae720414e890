"""The one table of chunk sizes: how much is worked on at a time, on a CPU unless it says otherwise.

None of them changes a result, but for the last bits of sums on an accelerator. A chunk is large enough for
wide vectors and few iterations, and small enough for its scratch memory to stay in the cache; with one row at
a time XLA compiles a loop to native code.
``python -m benchmarks.bench_chunks NAME`` times a size against its half and its double on real sweeps, in the
step that it names; for sizes that it does not vary it names what chose them. What came of it is in
docs/notes/kernels_on_cpu.md, and for accelerators in docs/notes/accelerators.md.
"""

FILTER_BLOCKS = 1024
"""Occupied blocks of cells that mean shift moves at a time; a sweep of 64 beams has some 1,500 to 3,000."""

FILTER_BLOCK_CELLS = 4
"""Cells side by side in one of those blocks."""

MINIMA_TABLES = 4
"""Tables that points take turns with where a minimum is kept for each cell: neighbours lie in one cell, and a
processor waits for what it has just written."""

MAX_TABLES, TABLE_NUMBERS = 32, 2**20
"""Likewise on an accelerator, whose atomic updates of one address are serialized: at most so many private
tables, of so many numbers together."""

PLANES = 32
"""RANSAC hypotheses tried at a time: few enough for their residuals to stay in the cache."""

MAP_POINTS = 8192
"""Points whose cell, component or cluster is looked up at a time."""

STATISTICS_MAPS = 4
"""Maps gone through in one native loop: with too much to do in a step, it would no longer be native."""

HULL_POINTS = 4096
"""Points put into slices at a time: two threads share so large a chunk."""

HULLS = 32
"""Clusters whose hulls are traced at a time."""

ROTATIONS = 64
"""Clusters tried at all rotations at a time: their extents stay in the cache."""

VOTES = 64
"""Votes for the scene's direction at a time: few boxes of a sweep vote."""

PROPOSALS = 256
"""Proposals compared with the evidence at a time: a loop over their points has few, wide steps."""

RAYS = 128
"""Boxes that rays are cast over at a time, for votes as for scores: equal kernels are compiled once
(docs/notes/compile_time.md)."""

BOXES = 128
"""Boxes whose neighbourhood is counted at a time."""

RUN_ROWS = 32
"""Neighbouring rows of a run in one block of `jaxbox.xla.runs`; a count of 6 bits holds 63."""

RUN_BLOCKS, RUN_BLOCKS_ON_ACCELERATOR = 1024, 8192
"""Such blocks looked at in one go."""

PAIRS = 64
"""Rows compared with as many others at a time."""

RANKS = 16
"""Rows that all others are compared with in one step."""

OWNERS = 4096
"""Points whose detections are looked up at a time."""

FOLDED_POINTS = 4
"""Points of each cluster folded in one step of the loop over them."""

UNROLLED = 4, 3, 2, 1
"""Numbers taken in one iteration of a native loop, the most that leave no remainder, which would take
kernels of its own. Four are twice as fast as one."""

SUM_BLOCK = 512
"""Columns of sums in two levels, on an accelerator."""

SINGLE_KERNEL_NUMBERS = 62
"""Numbers that `jaxbox.xla.barriers.single_kernel` may copy: to XLA a loop that reads and writes more than a
kilobyte is not small."""
