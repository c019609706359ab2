"""Makes block.step, the part of this example cell.

Needs build123d, a large tool that is no dependency of truecell: install it in an environment of its own,
run `python make_block.py` there, and commit the STEP file. Frame and features, in millimetres:

- block 100 (x) by 150 (y) by 100 (z), one corner at the origin, the edges along positive x, y and z;
- top face at z = 100 with a blind bore, diameter 30, 25 deep, axis along z at (35, 45);
- a boss on the top, diameter 25, 15 tall, axis along z at (65, 105);
- the vertical edge at x = 100, y = 150 rounded with radius 8.
"""

from pathlib import Path

from build123d import Align, Axis, Box, Cylinder, Pos, Unit, export_step, fillet

CORNER = (Align.MIN, Align.MIN, Align.MIN)
ON_FLOOR = (Align.CENTER, Align.CENTER, Align.MIN)

block = Box(100, 150, 100, align=CORNER)
edge = block.edges().filter_by(Axis.Z).sort_by_distance((100, 150, 50))[0]
block = fillet(edge, radius=8)
block -= Pos(35, 45, 75) * Cylinder(radius=15, height=25, align=ON_FLOOR)
block += Pos(65, 105, 100) * Cylinder(radius=12.5, height=15, align=ON_FLOOR)

block.label = "bench-block"
export_step(block, str(Path(__file__).with_name("block.step")), unit=Unit.MM)
