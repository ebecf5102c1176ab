"""Floor 1: the properties of a fabric in SI units, and the spring constants of a sheet made of it."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from clothgym.checks import known, not_negative, positive
from clothgym.mesh import BEND_X, BEND_Y, EDGE, NUM_KINDS, OPPOSITE, SHEAR, STRUCTURAL_X, STRUCTURAL_Y, ClothMesh


@dataclass(frozen=True)
class Material:
    """A fabric.

    Attributes:
        density: mass per area [kg/m^2].
        stretch_stiffness: Young's modulus times thickness [N/m].
        shear_stiffness: shear modulus times thickness [N/m].
        bend_rigidity: plate rigidity B [N m].  A cylinder of curvature kappa stores B kappa^2 / 2 per area.  Skip springs
            (``bending="springs"``) have no rigidity in the flat state.  They store this energy where the radius of curvature is two
            grid spacings.
        damping_time: Kelvin-Voigt retardation time [s].  A spring's damper constant is this time multiplied by its stiffness.
        drag_coefficient: C_D of the fabric face-on to the wind, see ``forces.add_lane_air_forces``; a square plate has 1.2.
        skin_friction: C_F of the fabric edge-on to the wind, by the area of one side.
        air_drag: linear drag, force per area and velocity [N s/m^3], independent of the wind.  Real air has none.  It damps slow
            swings, which the quadratic law hardly damps.  0.72 gives the force of that law at 1 m/s.
        source: where the values come from.

    Raises:
        ValueError: a property that is negative or not finite, or a density or stretch stiffness of zero.
    """

    density: float = 0.150
    stretch_stiffness: float = 261.0
    shear_stiffness: float = 105.0
    bend_rigidity: float = 2.34e-6
    damping_time: float = 1e-4
    drag_coefficient: float = 1.2
    skin_friction: float = 0.02
    air_drag: float = 0.0
    source: str = ""

    def __post_init__(self) -> None:
        for field in fields(self):
            if field.name == "source":
                continue
            check = positive if field.name in ("density", "stretch_stiffness") else not_negative
            object.__setattr__(self, field.name, check(field.name, getattr(self, field.name)))

    @staticmethod
    def preset(name: str, **changes: float) -> Material:
        """A measured fabric, with optional changes to its properties: ``Material.preset("cotton", density=0.2)``.

        Raises:
            ValueError: an unknown preset or property (the message lists the known ones), or a value out of range.
        """
        known("material preset", name, PRESETS)
        for change in changes:
            known("material property", change, [field.name for field in fields(Material)])
        return replace(PRESETS[name], **changes)  # type: ignore[arg-type]


# Bending rigidity along the warp of 618 measured fabrics: minimum, deciles and maximum [N m].  Computed from dataset.csv of
# DrapeTester/ClothDrapeTester (SIGGRAPH Asia 2022, doi 10.1145/3550454.3555464), all rows, of which 251 are distinct.
MEASURED_RIGIDITIES = (3.37e-7, 1.645e-6, 3.156e-6, 5.85e-6, 9.22e-6, 1.378e-5, 2.106e-5, 3.17e-5, 4.77e-5, 6.66e-5, 2.657e-4)

# In-plane stiffness where bending alone was measured (docs/materials.md has the reasons): E t as of cloth under loads of about
# its own weight, and G t in the middle of what shear tests of woven fabrics give.
_WOVEN = {"stretch_stiffness": 300.0, "shear_stiffness": 40.0}
_KES = "Matsudaira et al. 2015 (doi 10.4188/jte.61.69)"
_ASSUMED = "E t and G t are assumed, as of woven fabrics"

# the fabrics of Clyde, Teran and Tamstorf 2017, whose densities are per area (the evidence is in docs/materials.md)
_SECOND_TABLE = "of the second table of the Codim-IPC driver (Li et al. 2021, arXiv:2012.04457)"

# In the sources with an E -- stretch: Young's modulus E times thickness t; shear: E t / (2 (1 + nu)); bending:
# E t^3 / (12 (1 - nu^2)).  2HB is the width of the bending loop.
# where hinges are named as a remedy: they swing at about 8 sqrt(B/rho)/h^2, and need no more substeps than there may be
LIGHT, HINGES_FASTEST = 0.1, 1e7  # mass per area [kg/m^2], frequency [rad/s]

PRESETS: dict[str, Material] = {
    "median": Material(
        density=0.197,
        bend_rigidity=1.39e-5,
        **_WOVEN,
        source="medians of 618 fabrics (ClothDrapeTester, doi 10.1145/3550454.3555464): 197 g/m^2, along the warp 13.9 uN m; "
        f"{_ASSUMED}",
    ),
    "cotton_broad": Material(
        density=0.1238,
        bend_rigidity=1.157e-5,
        **_WOVEN,
        source=f"cotton broad of {_KES}: B 0.118 gf cm^2/cm, 2HB 0.124 gf cm/cm, 12.38 mg/cm^2, 0.497 mm; {_ASSUMED}",
    ),
    "polyester_tropical": Material(
        density=0.1165,
        bend_rigidity=7.55e-6,
        **_WOVEN,
        source=f"polyester tropical of {_KES}: B 0.077 gf cm^2/cm, 2HB 0.029 gf cm/cm, 11.65 mg/cm^2, 0.340 mm; {_ASSUMED}",
    ),
    "wool_tropical": Material(
        density=0.1629,
        bend_rigidity=6.57e-6,
        **_WOVEN,
        source=f"wool tropical of {_KES}: B 0.067 gf cm^2/cm, 2HB 0.033 gf cm/cm, 16.29 mg/cm^2, 0.407 mm; {_ASSUMED}",
    ),
    "polyester_faille": Material(
        density=0.1043,
        bend_rigidity=1.863e-6,
        **_WOVEN,
        source=f"polyester faille of {_KES}: B 0.019 gf cm^2/cm, 2HB 0.007 gf cm/cm, 10.43 mg/cm^2, 0.226 mm; {_ASSUMED}",
    ),
    "penava_cotton": Material(
        density=0.1503,
        stretch_stiffness=261.1,
        shear_stiffness=105.0,
        bend_rigidity=2.34e-6,
        source="100 % cotton of the Codim-IPC driver (Li et al. 2021, arXiv:2012.04457): 472.64 kg/m^3, 0.318 mm, 0.821 MPa, "
        "nu 0.243; damping_time and the properties in air are not measured there, but chosen by us",
    ),
    "knit": Material(
        density=0.1782,
        stretch_stiffness=24.93,
        shear_stiffness=11.64,
        bend_rigidity=2.25e-7,
        source="95 % wool, 5 % lycra of the same driver: 543.29 kg/m^3, 0.328 mm, 0.076 MPa, nu 0.071",
    ),
    "polyester": Material(
        density=0.1646,
        stretch_stiffness=120.5,
        shear_stiffness=43.61,
        bend_rigidity=7.46e-7,
        source="100 % polyester of the same driver: 653.17 kg/m^3, 0.252 mm, 0.478 MPa, nu 0.381",
    ),
    "silk": Material(
        density=0.083,
        stretch_stiffness=102.6,
        shear_stiffness=51.3,
        bend_rigidity=2.77e-7,
        source=f"silk {_SECOND_TABLE}: 83 g/m^2, 0.18 mm, 0.57 MPa, nu 0",
    ),
    "wool": Material(
        density=0.4806,
        stretch_stiffness=474.9,
        shear_stiffness=237.4,
        bend_rigidity=6.484e-5,
        source=f"wool {_SECOND_TABLE}: 480.6 g/m^2, 1.28 mm, 0.371 MPa, nu 0; a coating",
    ),
    "denim": Material(
        density=0.4,
        stretch_stiffness=1615.7,
        shear_stiffness=807.8,
        bend_rigidity=5.865e-5,
        source=f"denim {_SECOND_TABLE}: 400 g/m^2, 0.66 mm, 2.448 MPa, nu 0",
    ),
}
PRESETS["cotton"] = PRESETS["cotton_broad"]


def rigidity_percentile(rigidity: float) -> float:
    """Share of 618 measured fabrics that bend more easily along the warp than a fabric of this rigidity [%].

    Interpolated between deciles in the logarithm; 0 and 100 beyond the extremes.

    Args:
        rigidity: plate rigidity B [N m].
    """
    deciles = np.linspace(0, 100, len(MEASURED_RIGIDITIES))
    return float(np.interp(np.log(positive("rigidity", rigidity)), np.log(MEASURED_RIGIDITIES), deciles))


def spring_stiffness(mesh: ClothMesh, stretch: NDArray, shear: NDArray, bend: NDArray) -> NDArray[np.float64]:
    """Spring constants by kind [N/m], (kinds, ...), that give a sheet the fabric's moduli.

    The edges of a triangle mesh are of one kind.  With Van Gelder's weights their stiffness is Young's modulus.  Poisson's ratio is
    then 1/3.  The shear modulus follows from these two and ignores that of the fabric (see ``triangles.triangle_mesh``).

    Let a grid have cells a x b with diagonals d, springs k_x, k_y, k_d (both diagonals) and skip springs k_b.  The sheet then has
    ``C11 = (k_x + 4 k_bx) a/b + 2 k_d a^3/(b d^2)`` and ``C12 = C66 = 2 k_d a b/d^2``.  Its Young's modulus is ``C11 - C12^2/C11``
    and its Poisson's ratio ``C12/C11``.  This holds for small strains; the tests check it on stretched and sheared sheets.

    stretch, shear [N/m] and bend [N m] have the same shape ``(...)``.

    Raises:
        ValueError: no spring network has these moduli (shear too stiff for the stretch, or cells too oblong).
    """
    stretch, shear, bend = (np.asarray(q, np.float64) for q in (stretch, shear, bend))
    k = np.zeros((NUM_KINDS, *stretch.shape))
    # triangles: edges, and skip springs between opposite corners
    if mesh.shape is None:
        k[EDGE], k[OPPOSITE] = stretch, 1024 * bend
        return k
    # a grid: the diagonals take the shear, and the structural springs the rest of C11
    a, b = mesh.spacing
    d2 = a * a + b * b
    k[SHEAR] = shear * d2 / (2 * a * b)
    c11 = (stretch + np.sqrt(stretch**2 + 4 * shear**2)) / 2
    for structural, skip, along, across in ((STRUCTURAL_X, BEND_X, a, b), (STRUCTURAL_Y, BEND_Y, b, a)):
        # skip springs store k kappa^4 along^5 / (32 across) per area; this equals B kappa^2 / 2 at kappa = 1 / (2 along)
        k[skip] = 64 * bend * across / along**3
        k[structural] = (c11 - 2 * k[SHEAR] * along**3 / (across * d2)) * across / along - 4 * k[skip]
    if np.any(k < 0):
        # without rigidity, the structural springs are stiffer by four times the skip springs
        bare = k[STRUCTURAL_X] + 4 * k[BEND_X], k[STRUCTURAL_Y] + 4 * k[BEND_Y]
        remedy = "lower the shear stiffness, or make the cells more nearly square"
        if min(bare[0].min(), bare[1].min()) >= 0:
            hinges = 8 * np.sqrt(bend.max() / LIGHT) / min(a, b) ** 2 < HINGES_FASTEST
            most = min((bare[0] * a**3 / (256 * b)).min(), (bare[1] * b**3 / (256 * a)).min())
            remedy = (
                "take bending='hinge' or 'quadratic', with which hinges bear the rigidity in place of springs, or "
                if hinges
                else ""
            )
            remedy += f"lower the rigidity to {most:.3g} N m, or use a coarser grid"
        raise ValueError(
            f"no springs on cells of {a:.4g} x {b:.4g} m have stretch_stiffness={stretch.min():.4g} N/m with "
            f"shear_stiffness={shear.max():.4g} N/m and bend_rigidity={bend.max():.4g} N m: {remedy}"
        )
    return k
