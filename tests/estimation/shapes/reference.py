"""Least-squares surfaces to 50 digits: Gauss-Newton in mpmath from the truth, own parametrisation."""

from mpmath import mp, mpf

from tests.estimation.shapes.clouds import Cloud

_STEP = mpf(10) ** -20  # of central differences: exact to 40 digits


def fit(kind: str, data: Cloud) -> tuple[list[mpf], list[mpf], list[mpf]]:
    """Point (centre, apex, or on the axis or plane nearest to the centroid), unit axis, and sizes."""
    with mp.workdps(50):
        points = [[mpf(float(x)) for x in row] for row in data.points_m]
        count = len(points)
        centroid = [sum(p[k] for p in points) / count for k in range(3)]
        axis = _unit([mpf(float(x)) for x in data.axis])
        helper = [mpf(1), mpf(0), mpf(0)] if abs(axis[0]) < 0.6 else [mpf(0), mpf(1), mpf(0)]
        across = _unit(_cross(axis, helper))
        beside = _cross(axis, across)
        start = [mpf(float(x)) for x in data.centre_m]
        free = {"plane": "wab", "sphere": "uvw", "cylinder": "uvab", "cone": "uvwab", "torus": "uvwab"}[kind]
        values = [mpf(0)] * len(free) + [mpf(float(s)) for s in data.sizes]

        def place(x: list[mpf]) -> tuple[list[mpf], list[mpf], list[mpf]]:
            named = dict(zip(free, x, strict=False))
            u, v, w, a, b = (named.get(name, mpf(0)) for name in "uvwab")
            point = [start[k] + u * across[k] + v * beside[k] + w * axis[k] for k in range(3)]
            direction = _unit([axis[k] + a * across[k] + b * beside[k] for k in range(3)])
            return point, direction, x[len(free) :]

        def residuals(x: list[mpf]) -> list[mpf]:
            point, direction, sizes = place(x)
            return [_distance(kind, p, point, direction, sizes) for p in points]

        for _ in range(60):
            base = residuals(values)
            columns = []
            for k in range(len(values)):
                up, down = list(values), list(values)
                up[k] += _STEP
                down[k] -= _STEP
                columns.append(
                    [(a - b) / (2 * _STEP) for a, b in zip(residuals(up), residuals(down), strict=True)]
                )
            size = len(values)
            normal = mp.matrix(size, size)
            right = mp.matrix(size, 1)
            for i in range(size):
                right[i] = -mp.fdot(columns[i], base)
                for j in range(size):
                    normal[i, j] = mp.fdot(columns[i], columns[j])
            step = mp.lu_solve(normal, right)
            values = [value + step[k] for k, value in enumerate(values)]
            if max(abs(step[k]) for k in range(size)) < mpf(10) ** -25:
                break
        else:
            raise AssertionError("the reference did not converge")
        point, direction, sizes = place(values)
        if kind in ("cylinder", "plane"):
            offset = _dot(direction, [centroid[k] - point[k] for k in range(3)])
            if kind == "cylinder":
                point = [point[k] + offset * direction[k] for k in range(3)]
            else:
                point = [centroid[k] - offset * direction[k] for k in range(3)]
        return point, direction, sizes


def _distance(kind: str, p: list[mpf], point: list[mpf], axis: list[mpf], sizes: list[mpf]) -> mpf:
    d = [p[k] - point[k] for k in range(3)]
    w = _dot(axis, d)
    if kind == "plane":
        return w
    square = _dot(d, d)
    if kind == "sphere":
        return mp.sqrt(square) - sizes[0]
    rho = mp.sqrt(square - w * w)
    if kind == "cylinder":
        return rho - sizes[0]
    if kind == "cone":
        return rho * mp.cos(sizes[0]) - w * mp.sin(sizes[0])
    return mp.sqrt((rho - sizes[0]) ** 2 + w * w) - sizes[1]


def _dot(a: list[mpf], b: list[mpf]) -> mpf:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: list[mpf], b: list[mpf]) -> list[mpf]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def _unit(a: list[mpf]) -> list[mpf]:
    length = mp.sqrt(_dot(a, a))
    return [x / length for x in a]
