"""STEP files of boxes and cylinders, written entity by entity, so that their truth is known."""

from collections.abc import Callable, Iterable, Sequence

import numpy as np

Vector = tuple[float, float, float]


class StepWriter:
    """The entities of one file; calling it adds one and returns its name."""

    def __init__(self) -> None:
        self.entities: list[str] = []

    def __call__(self, entity: str) -> str:
        self.entities.append(entity)
        return f"#{len(self.entities)}"

    def text(self) -> str:
        """Return the file."""
        data = "\n".join(f"#{n}={entity};" for n, entity in enumerate(self.entities, start=1))
        return (
            "ISO-10303-21;\nHEADER;\nFILE_DESCRIPTION((''),'2;1');\n"
            "FILE_NAME('','',(''),(''),'','','');\n"
            "FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));\nENDSEC;\n"
            f"DATA;\n{data}\nENDSEC;\nEND-ISO-10303-21;\n"
        )

    def point(self, position: Iterable[float]) -> str:
        """Add a point."""
        x, y, z = (float(value) for value in position)
        return self(f"CARTESIAN_POINT('',({x!r},{y!r},{z!r}))")

    def direction(self, direction: Iterable[float]) -> str:
        """Add a direction."""
        x, y, z = (float(value) for value in direction)
        return self(f"DIRECTION('',({x!r},{y!r},{z!r}))")

    def axes(self, origin: Iterable[float], z: Vector = (0, 0, 1), x: Vector = (1, 0, 0)) -> str:
        """Add a frame."""
        return self(
            f"AXIS2_PLACEMENT_3D('',{self.point(origin)},{self.direction(z)},{self.direction(x)})"
        )

    def face(self, edges: Sequence[str], surface: str) -> str:
        """Add a face bounded by oriented edges."""
        loop = self(f"EDGE_LOOP('',({','.join(edges)}))")
        bound = self(f"FACE_OUTER_BOUND('',{loop},.T.)")
        return self(f"ADVANCED_FACE('',({bound}),{surface},.T.)")

    def solid(self, faces: Sequence[str]) -> str:
        """Add a solid."""
        shell = self(f"CLOSED_SHELL('',({','.join(faces)}))")
        return self(f"MANIFOLD_SOLID_BREP('',{shell})")

    def context(self, unit: str) -> str:
        """Add what all shapes are measured in: "mm", "m" or "in"."""
        if unit == "m":
            length = self("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT($,.METRE.))")
        else:
            length = self("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))")
        if unit == "in":
            size = self("DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.)")
            inch = self(f"LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),{length})")
            length = self(f"(CONVERSION_BASED_UNIT('INCH',{inch})LENGTH_UNIT()NAMED_UNIT({size}))")
        angle = self("(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.))")
        solid = self("(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT())")
        return self(
            "(GEOMETRIC_REPRESENTATION_CONTEXT(3)"
            f"GLOBAL_UNIT_ASSIGNED_CONTEXT(({length},{solid},{angle}))"
            "REPRESENTATION_CONTEXT('',''))"
        )

    def product(self, application: str, name: str, context: str, items: str) -> tuple[str, str]:
        """Add a product; returns its definition and its shape."""
        about = self(f"PRODUCT_CONTEXT('',{application},'mechanical')")
        product = self(f"PRODUCT('{name}','{name}','',({about}))")
        formation = self(f"PRODUCT_DEFINITION_FORMATION('','',{product})")
        design = self(f"PRODUCT_DEFINITION_CONTEXT('part definition',{application},'design')")
        definition = self(f"PRODUCT_DEFINITION('design','',{formation},{design})")
        shape = self(f"PRODUCT_DEFINITION_SHAPE('','',{definition})")
        what = "ADVANCED_BREP_SHAPE_REPRESENTATION"
        representation = self(f"{what}('{name}',({items}),{context})")
        self(f"SHAPE_DEFINITION_REPRESENTATION({shape},{representation})")
        return definition, representation


def step_box(writer: StepWriter, size: Vector) -> str:
    """Add a box with one corner at the origin."""
    corners = [np.array([i, j, k]) * size for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    vertices = [writer(f"VERTEX_POINT('',{writer.point(corner)})") for corner in corners]
    made: dict[tuple[int, int], str] = {}

    def edge(a: int, b: int) -> str:
        if (b, a) in made:
            return writer(f"ORIENTED_EDGE('',*,*,{made[b, a]},.F.)")
        length = float(np.linalg.norm(corners[b] - corners[a]))
        along = writer.direction((corners[b] - corners[a]) / length)
        vector = writer(f"VECTOR('',{along},1.)")
        line = writer(f"LINE('',{writer.point(corners[a])},{vector})")
        made[a, b] = writer(f"EDGE_CURVE('',{vertices[a]},{vertices[b]},{line},.T.)")
        return writer(f"ORIENTED_EDGE('',*,*,{made[a, b]},.T.)")

    faces = []
    for loop, normal in (
        ((0, 1, 3, 2), (-1, 0, 0)),
        ((4, 6, 7, 5), (1, 0, 0)),
        ((0, 4, 5, 1), (0, -1, 0)),
        ((2, 3, 7, 6), (0, 1, 0)),
        ((0, 2, 6, 4), (0, 0, -1)),
        ((1, 5, 7, 3), (0, 0, 1)),
    ):
        edges = [edge(loop[n], loop[(n + 1) % 4]) for n in range(4)]
        across = (0, 1, 0) if normal[0] else (1, 0, 0)
        plane = writer(f"PLANE('',{writer.axes(corners[loop[0]], normal, across)})")
        faces.append(writer.face(edges, plane))
    return writer.solid(faces)


def step_cylinder(writer: StepWriter, radius: float, height: float) -> str:
    """Add a cylinder that stands on the origin along z."""

    def circle(z: float) -> tuple[str, str]:
        vertex = writer(f"VERTEX_POINT('',{writer.point((radius, 0, z))})")
        curve = writer(f"CIRCLE('',{writer.axes((0, 0, z))},{float(radius)!r})")
        return vertex, writer(f"EDGE_CURVE('',{vertex},{vertex},{curve},.T.)")

    def oriented(edge: str, sense: str) -> str:
        return writer(f"ORIENTED_EDGE('',*,*,{edge},.{sense}.)")

    low, low_circle = circle(0.0)
    high, high_circle = circle(height)
    up = writer(f"VECTOR('',{writer.direction((0, 0, 1))},1.)")
    line = writer(f"LINE('',{writer.point((radius, 0, 0))},{up})")
    seam = writer(f"EDGE_CURVE('',{low},{high},{line},.T.)")
    mantle = writer(f"CYLINDRICAL_SURFACE('',{writer.axes((0, 0, 0))},{float(radius)!r})")
    around = [(low_circle, "T"), (seam, "T"), (high_circle, "F"), (seam, "F")]
    floor = writer(f"PLANE('',{writer.axes((0, 0, 0), (0, 0, -1))})")
    lid = writer(f"PLANE('',{writer.axes((0, 0, height))})")
    return writer.solid(
        [
            writer.face([oriented(edge, sense) for edge, sense in around], mantle),
            writer.face([oriented(low_circle, "F")], floor),
            writer.face([oriented(high_circle, "T")], lid),
        ]
    )


def step_file(shape: Callable[..., str], unit: str, *arguments: object, name: str = "solid") -> str:
    """Return a file of one part."""
    writer = StepWriter()
    application = writer("APPLICATION_CONTEXT('core data')")
    context = writer.context(unit)
    solid = shape(writer, *arguments)
    writer.product(application, name, context, f"{writer.axes((0, 0, 0))},{solid}")
    return writer.text()


def step_assembly(
    unit: str, boxes: dict[str, Vector], places: Sequence[tuple[str, Vector, Vector, Vector]]
) -> str:
    """Return a file of boxes by name, placed by their origin, their z and their x."""
    writer = StepWriter()
    application = writer("APPLICATION_CONTEXT('core data')")
    context = writer.context(unit)
    made = {}
    for name, size in boxes.items():
        origin = writer.axes((0, 0, 0))
        items = f"{origin},{step_box(writer, size)}"
        made[name] = (*writer.product(application, name, context, items), origin)
    frames = [writer.axes(origin, z, x) for _, origin, z, x in places]
    items = ",".join([writer.axes((0, 0, 0)), *frames])
    whole, whole_shape = writer.product(application, "assembly", context, items)
    for number, ((name, *_), frame) in enumerate(zip(places, frames, strict=True)):
        part, shape, origin = made[name]
        use = writer(
            f"NEXT_ASSEMBLY_USAGE_OCCURRENCE('NAUO{number}','NAUO{number}','',{whole},{part},$)"
        )
        placed = writer(f"PRODUCT_DEFINITION_SHAPE('','',{use})")
        moved = writer(f"ITEM_DEFINED_TRANSFORMATION('','',{origin},{frame})")
        relation = writer(
            f"(REPRESENTATION_RELATIONSHIP('','',{shape},{whole_shape})"
            f"REPRESENTATION_RELATIONSHIP_WITH_TRANSFORMATION({moved})"
            "SHAPE_REPRESENTATION_RELATIONSHIP())"
        )
        writer(f"CONTEXT_DEPENDENT_SHAPE_REPRESENTATION({relation},{placed})")
    return writer.text()


def step_torus(writer: StepWriter, major: float, minor: float) -> str:
    """Add a torus about z, its one face bounded by the two circles along which it was cut."""
    vertex = writer(f"VERTEX_POINT('',{writer.point((major + minor, 0, 0))})")
    around = writer(f"CIRCLE('',{writer.axes((0, 0, 0))},{major + minor!r})")
    across = writer(f"CIRCLE('',{writer.axes((major, 0, 0), (0, -1, 0))},{float(minor)!r})")
    edges = [writer(f"EDGE_CURVE('',{vertex},{vertex},{curve},.T.)") for curve in (around, across)]
    loop = [
        writer(f"ORIENTED_EDGE('',*,*,{edges[k]},.{sense}.)")
        for k, sense in ((0, "T"), (1, "T"), (0, "F"), (1, "F"))
    ]
    surface = f"TOROIDAL_SURFACE('',{writer.axes((0, 0, 0))},{float(major)!r},{float(minor)!r})"
    return writer.solid([writer.face(loop, writer(surface))])
