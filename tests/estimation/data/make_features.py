"""Makes features.step for test_cad.py: every kind of face, material on either side, in a turned assembly.

Needs build123d, like cells/bench-block/make_block.py. In the frame `plate`, in millimetres: a plate of
80 x 60 x 20, bottom centre at the origin; on its top z = 20 a conical pit (apex at (-25, 0, 12), half angle
45 deg), half a ball of radius 6 at (0, 0, 20), half a dimple of radius 5 at (20, 15, 20), a boss of radius 7
at (20, -15), 10 tall, its rim rounded with radius 2. Beside it a free-form body. In the assembly the plate is
turned by 90 degrees about x and moved by (10, 20, 30); the free-form body is not.
"""

from pathlib import Path

from build123d import (
    Align,
    Box,
    Compound,
    Cone,
    Cylinder,
    Face,
    GeomType,
    Pos,
    Rot,
    Sphere,
    Unit,
    Vector,
    export_step,
    extrude,
    fillet,
)

MIN_Z = (Align.CENTER, Align.CENTER, Align.MIN)

boss = Pos(20, -15, 20) * Cylinder(radius=7, height=10, align=MIN_Z)
boss = fillet(boss.edges().filter_by(GeomType.CIRCLE).sort_by(lambda edge: edge.center().Z)[-1], radius=2)
plate = Box(80, 60, 20, align=MIN_Z) + boss
plate -= Pos(-25, 0, 12) * Cone(bottom_radius=0, top_radius=8, height=8, align=MIN_Z)
plate += Pos(0, 0, 20) * Sphere(radius=6)
plate -= Pos(20, 15, 20) * Sphere(radius=5)
plate.label = "plate"

heights = [[Vector(100 + 10 * i, 10 * j, 3 * ((i + 2 * j) % 3)) for j in range(4)] for i in range(4)]
wavy = extrude(Face.make_surface_from_array_of_points(heights), amount=5, dir=(0, 0, 1))
wavy.label = "wavy"

assembly = Compound(label="features", children=[Pos(10, 20, 30) * Rot(90, 0, 0) * plate, wavy])
export_step(assembly, str(Path(__file__).with_name("features.step")), unit=Unit.MM)
