"""From samples to colors: fabric, solids, floor and light.

Arrays are float32; the arithmetic between them is numba's choice (float64 with literals), which makes little difference to the few
dozen nanoseconds of a color.  Colors are linear light until the end, where a table converts them to sRGB.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from clothgym._jit import kernel
from clothgym.render.raster import HALF_PIXEL, NOT_DRAWN, SUBPIXEL, sample_weights
from clothgym.render.solids import linear_color

# rows of the palette
FRONT, FRONT_CHECK, BACK, BACK_CHECK, FLOOR, LINE, HORIZON, ZENITH, SOLIDS = range(9)
CORAL, CREAM = (206, 64, 50), (247, 228, 206)
INDIGO = (54, 68, 132)
STUDIO = ((226, 222, 214), (205, 200, 191), (240, 238, 234), (222, 227, 232))  # floor, its lines, horizon, zenith

KEY = (0.90, 0.86, 0.79)  # light of the lamp, before the cosine
SKY = (0.43, 0.43, 0.45)  # from straight above
BOUNCE = (0.40, 0.36, 0.32)  # from the floor
TILES = 10.0  # on a meter of the floor
LINE_WIDTH = 0.0016  # [m]
ROOF_HEIGHT = 0.10  # height above at which a surface blocks most of the sky's light [m]
TEXELS_ASIDE = 1.5
TRANSLUCENCE = 0.30  # share of the lamp's light that passes through the fabric
SHEEN, GLOSS = 0.35, 0.10  # light scattered along a silhouette; highlight of a solid
CLOTH = 0  # surface number of the cloth; solids are 1, 2, ...
SHADE = (0.50, 0.48, 0.43)  # share of the floor's light that the lamp's shadow takes
TOUCHED, HUNG_OVER = 0.55, 0.45  # share that a surface takes that touches the floor, and one that hangs over it
ROOFED = 0.55  # share of the sky that a surface above takes
HOLLOW, MOST_HOLLOW, MOST_RIDGE = 0.012, 0.5, 0.25  # share of the sky that a hollow loses, by its curvature [m], and bounds
YARNS, RELIEF = 20.0, 0.12  # yarns in a stripe; how much brighter warp is than weft
COVER = 0.85  # share of a crossing that the upper yarn covers; the lower one shows at its sides
FINEST = 2.0  # yarns in a footprint from which on they are not drawn one by one
STEEPEST = 2.0  # slope to the eye up to which one sample of a surface stands for all of a pixel
TONES = 8192
SHOULDER, BRIGHTEST = 0.70, 2.0  # light above the shoulder is compressed, as film does, so that bright folds keep their shape

_curve = np.linspace(0, BRIGHTEST, TONES)
_curve = np.where(_curve < SHOULDER, _curve, 1 - (1 - SHOULDER) * np.exp(-np.maximum(_curve - SHOULDER, 0) / (1 - SHOULDER)))
_srgb = np.where(_curve <= 0.0031308, 12.92 * _curve, 1.055 * _curve ** (1 / 2.4) - 0.055)
SRGB: NDArray[np.uint8] = np.round(255 * _srgb).astype(np.uint8)


def cloth_and_floor_palette(front: tuple[int, int, int], back: tuple[int, int, int]) -> NDArray[np.float32]:
    """Linear colors of fabric and studio, (SOLIDS, 3); those of solids follow."""
    cream = linear_color(CREAM)
    rows = []
    for color in map(linear_color, (front, back)):
        rows += [color, color + np.float32(0.6) * (cream - color)]
    return np.stack(rows + [linear_color(color) for color in STUDIO])


@kernel
def _stripes(q, width):
    """Share of [q - width/2, q + width/2] in which floor(q) is odd, 0 to 1: stripes of width 1, seen through a box filter."""
    a, b = 0.5 * (q - 0.5 * width), 0.5 * (q + 0.5 * width)
    below, above = np.floor(a), np.floor(b)
    return (above - below + max(2 * (b - above) - 1, 0) - max(2 * (a - below) - 1, 0)) / width


@kernel
def _line(q, line, width):
    """Share of [q - width/2, q + width/2] that lies within line/2 of a whole number."""
    a, b = q - 0.5 * width + 0.5 * line, q + 0.5 * width + 0.5 * line
    below, above = np.floor(a), np.floor(b)
    return ((above - below) * line + min(b - above, line) - min(a - below, line)) / width


@kernel
def _lit(shadow, box, axes, center, scale, slack, x, y, z):
    """Share of the lamp that reaches a point [m], 0 to 1: 3 x 3 texels around it, the outer ones in part (Reeves 1987)."""
    dx, dy, dz = x - center[0], y - center[1], z - center[2]
    size = shadow.shape[0]
    u = 0.5 * size + scale * (axes[0][0] * dx + axes[0][1] * dy + axes[0][2] * dz) - 0.5
    v = 0.5 * size - scale * (axes[1][0] * dx + axes[1][1] * dy + axes[1][2] * dz) - 0.5
    if not (box[0] <= u < box[1] and box[2] <= v < box[3]):
        return 1.0
    near = np.float32(axes[2][0] * dx + axes[2][1] * dy + axes[2][2] * dz + slack)
    column, row = int(u), int(v)
    fu, fv = u - column, v - row
    total = 0.0
    for a in range(4):
        r = row - 1 + a
        share = 1 - fu if shadow[r, column - 1] <= near else 0.0
        share += 1.0 if shadow[r, column] <= near else 0.0
        share += 1.0 if shadow[r, column + 1] <= near else 0.0
        share += fu if shadow[r, column + 2] <= near else 0.0
        total += share * (1 - fv if a == 0 else (fv if a == 3 else 1.0))
    return total / 9


@kernel
def _bilinear(field, row, column, channel, fu, fv):
    """Bilinear value of a channel between four texels."""
    upper = field[row, column, channel] * (1 - fu) + field[row, column + 1, channel] * fu
    lower = field[row + 1, column, channel] * (1 - fu) + field[row + 1, column + 1, channel] * fu
    return upper * (1 - fv) + lower * fv


@kernel
def _heights_at(heights, box, center, scale, x, y):
    """The three height maps at (x, y) [m], bilinear; zeros outside."""
    size = heights.shape[0]
    u = 0.5 * size + scale * (x - center[0]) - 0.5
    v = 0.5 * size - scale * (y - center[1]) - 0.5
    if not (box[0] <= u < box[1] and box[2] <= v < box[3]):
        return 0.0, 0.0, 0.0
    column, row = int(u), int(v)
    fu, fv = u - column, v - row
    touching = _bilinear(heights, row, column, 0, fu, fv)
    hanging = _bilinear(heights, row, column, 1, fu, fv)
    return touching, hanging, _bilinear(heights, row, column, 2, fu, fv)


@kernel
def _background(up, palette):
    """Linear color above the horizon; up: slope of the ray."""
    t = min(1.5 * up, 1)
    low, high = palette[HORIZON], palette[ZENITH]
    return low[0] + t * (high[0] - low[0]), low[1] + t * (high[1] - low[1]), low[2] + t * (high[2] - low[2])


@kernel
def _tile_ink(x, y, depth, dx, dy, dz, rays, antialias):
    """Share of a pixel's footprint on the floor at (x, y) [m] that the lines between tiles cover."""
    # how far the point moves from one pixel to the next, right and down
    sx, sy, tiles = rays[2][2] / dz, rays[3][2] / dz, depth * TILES * antialias
    wide_x = tiles * (abs(rays[2][0] - dx * sx) + abs(rays[3][0] - dx * sy))
    wide_y = tiles * (abs(rays[2][1] - dy * sx) + abs(rays[3][1] - dy * sy))
    ink_x, ink_y = _line(x * TILES, LINE_WIDTH * TILES, wide_x), _line(y * TILES, LINE_WIDTH * TILES, wide_y)
    return ink_x + ink_y - ink_x * ink_y


@kernel
def draw_studio(rays, reach, center, palette, antialias, studio):
    """Empty floor and background, linear, (height, width, 3): the same in all frames of a camera."""
    floor, line, horizon = palette[FLOOR], palette[LINE], palette[HORIZON]
    for row in range(studio.shape[0]):
        for column in range(studio.shape[1]):
            px, py = (column + 0.5) * antialias, (row + 0.5) * antialias
            dx = rays[1][0] + px * rays[2][0] + py * rays[3][0]
            dy = rays[1][1] + px * rays[2][1] + py * rays[3][1]
            dz = rays[1][2] + px * rays[2][2] + py * rays[3][2]
            if dz >= 0:
                color = _background(dz, palette)
                for c in range(3):
                    studio[row, column, c] = color[c]
                continue
            depth = -rays[0][2] / dz
            x, y = rays[0][0] + depth * dx, rays[0][1] + depth * dy
            away = np.sqrt((x - center[0]) ** 2 + (y - center[1]) ** 2) / reach
            fade = min(max((away - 0.9) / 3.2, 0), 1)
            fade = fade * (2 - fade)
            ink = _tile_ink(x, y, depth, dx, dy, dz, rays, antialias)
            for c in range(3):
                tile = floor[c] + ink * (line[c] - floor[c])
                studio[row, column, c] = tile + fade * (horizon[c] - tile)


@kernel
def _cast_on_floor(cast, box, axes, center, scale, x, y):
    """The lamp's shadow on the floor at (x, y) [m], 0 to 1, bilinear."""
    dx, dy, dz = x - center[0], y - center[1], -center[2]
    size = cast.shape[0]
    u = 0.5 * size + scale * (axes[0][0] * dx + axes[0][1] * dy + axes[0][2] * dz) - 0.5
    v = 0.5 * size - scale * (axes[1][0] * dx + axes[1][1] * dy + axes[1][2] * dz) - 0.5
    if not (box[0] <= u < box[1] and box[2] <= v < box[3]):
        return 0.0
    column, row = int(u), int(v)
    return _bilinear(cast, row, column, 0, u - column, v - row)


@kernel
def _tone(u, v, check, footprint):
    """0 where the fabric has its color, 1 where it is light, and the brightness of its yarns: woven gingham.

    Stripes of warp cross stripes of weft; a yarn of one lies over and under those of the other in turn.  Where yarns are too fine
    to be seen, half of each shows.  u, v, check, footprint [m].
    """
    width = max(footprint / check, 1e-6)
    warp, weft = _stripes(u / check, width), _stripes(v / check, width)
    over, fine = 0.5, YARNS * width
    if fine < FINEST:
        over += (4 * COVER - 2) * (_stripes(u / check * YARNS, fine) - 0.5) * (_stripes(v / check * YARNS, fine) - 0.5)
    return weft + over * (warp - weft), 1 + RELIEF * (over - 0.5)


@kernel
def _fabric(uv, values, triangles, t, w0, w1, w2, footprint, check, palette, heat, front):
    """Linear color of the cloth at a point of triangle t."""
    i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
    if len(values) > 0:
        value = w0 * values[i] + w1 * values[j] + w2 * values[k]
        step = int(min(max(value, 0), 1) * (len(heat) - 1) + 0.5)
        return heat[step, 0], heat[step, 1], heat[step, 2]
    u = w0 * uv[i, 0] + w1 * uv[j, 0] + w2 * uv[k, 0]
    v = w0 * uv[i, 1] + w1 * uv[j, 1] + w2 * uv[k, 1]
    tone, relief = _tone(u, v, check, footprint)
    dark, light = palette[FRONT if front else BACK], palette[FRONT_CHECK if front else BACK_CHECK]
    r, g, b = dark[0] + tone * (light[0] - dark[0]), dark[1] + tone * (light[1] - dark[1]), dark[2] + tone * (light[2] - dark[2])
    return relief * r, relief * g, relief * b


@kernel
def survey(screen, owner, buffer, surface, antialias, smoothness, seen):
    """How many samples of each pixel show a surface, or -1 where all show one even piece of it: ``seen``, (height, width) int32.

    Where nearness differs within a pixel by more than the share ``smoothness`` the surface is not even.
    """
    height, width = seen.shape
    left, right, top, bottom = width, -1, height, -1
    for v in range(screen.shape[0]):
        if screen[v, 0] != NOT_DRAWN:
            column, row = screen[v, 0] // (SUBPIXEL * antialias), screen[v, 1] // (SUBPIXEL * antialias)
            left, right = min(left, column), max(right, column)
            top, bottom = min(top, row), max(bottom, row)
    seen[:] = 0
    for row in range(max(top, 0), min(bottom + 1, height)):
        for column in range(max(left, 0), min(right + 1, width)):
            t = owner[row * antialias, column * antialias]
            low = high = buffer[row * antialias, column * antialias]
            kind = surface[t] if t >= 0 else -1
            full, same = 0, kind >= 0
            for s in range(row * antialias, (row + 1) * antialias):
                for q in range(column * antialias, (column + 1) * antialias):
                    t = owner[s, q]
                    if t >= 0:
                        full += 1
                        same &= surface[t] == kind
                        low, high = min(low, buffer[s, q]), max(high, buffer[s, q])
            even = same and full == antialias * antialias and high - low <= smoothness * low
            seen[row, column] = -1 if even else full


@kernel
def shade_floor(rays, view, maps, rig, studio, antialias, seen, light):
    """Write the studio, darkened by shadows, to ``light``, (height, width, 3), less the share of each pixel that surfaces cover.

    Shadows on the floor are smooth: one sample in the middle of a pixel is enough.
    """
    _, _, cast, cast_box, heights, heights_box, floor_box = maps
    axes, center, shadow_scale, height_scale, _ = rig
    height, width, _ = light.shape
    left, right, top, bottom = _pixels_of_floor(floor_box, rays[0], view, width, height)
    share = 1 / (antialias * antialias)
    for row in range(height):
        for column in range(width):
            shadowed = top <= row <= bottom and left <= column <= right
            if seen[row, column] == 0 and not shadowed:
                light[row, column, 0] = studio[row, column, 0]
                light[row, column, 1] = studio[row, column, 1]
                light[row, column, 2] = studio[row, column, 2]
                continue
            part = 1 - share * seen[row, column] if seen[row, column] >= 0 else 0.0
            r, g, b = part, part, part
            px, py = (column + 0.5) * antialias, (row + 0.5) * antialias
            dz = rays[1][2] + px * rays[2][2] + py * rays[3][2]
            if shadowed and part > 0 and dz < 0:
                depth = -rays[0][2] / dz
                x = rays[0][0] + depth * (rays[1][0] + px * rays[2][0] + py * rays[3][0])
                y = rays[0][1] + depth * (rays[1][1] + px * rays[2][1] + py * rays[3][1])
                if floor_box[0] <= x <= floor_box[1] and floor_box[2] <= y <= floor_box[3]:
                    dark = _cast_on_floor(cast, cast_box, axes, center, 0.5 * shadow_scale, x, y)
                    touching, hanging, _ = _heights_at(heights, heights_box, center, height_scale, x, y)
                    part *= (1 - TOUCHED * touching) * (1 - HUNG_OVER * hanging)
                    r, g, b = part * (1 - SHADE[0] * dark), part * (1 - SHADE[1] * dark), part * (1 - SHADE[2] * dark)
            light[row, column, 0] = r * studio[row, column, 0]
            light[row, column, 1] = g * studio[row, column, 1]
            light[row, column, 2] = b * studio[row, column, 2]


@kernel
def _pixels_of_floor(box, eye, view, width, height):
    """First and last column, first and last row where a rectangle of the floor (lowest and highest x, then y [m]) may be seen."""
    axes, scale, near = view
    left, right, top, bottom = width - 1, 0, height - 1, 0
    for corner in range(4):
        dx, dy = box[corner & 1] - eye[0], box[2 + (corner >> 1)] - eye[1]
        depth = axes[2][0] * dx + axes[2][1] * dy - axes[2][2] * eye[2]
        if depth < near:  # the rectangle reaches behind the eye
            return 0, width - 1, 0, height - 1
        along, up = axes[0][0] * dx + axes[0][1] * dy - axes[0][2] * eye[2], axes[1][0] * dx + axes[1][1] * dy - axes[1][2] * eye[2]
        column = int(min(max(0.5 * width + scale * along / depth, -1), width))
        row = int(min(max(0.5 * height - scale * up / depth, -1), height))
        left, right, top, bottom = min(left, column - 1), max(right, column + 1), min(top, row - 1), max(bottom, row + 1)
    return left, right, top, bottom


@kernel
def shade_surfaces(rays, look, mesh, maps, rig, antialias, owner, seen, light):
    """Add cloth and solids, linear, to ``light``, (height, width, 3): the mean over each pixel's antialias^2 samples.

    owner: triangle seen by a sample or -1, (height antialias, width antialias).  seen: see ``survey``.  rays: of the samples'
    image.  Light and pattern are smooth: where all samples show one even piece of surface, one in the middle is enough.
    """
    screen, inverse_depth, triangles, normals, uv, surface, curvature, values = mesh
    palette, check, heat = look
    shadow, shadow_box, _, _, heights, heights_box, _ = maps
    axes, center, shadow_scale, height_scale, slack = rig
    slope = np.sqrt(rays[2][0] ** 2 + rays[2][1] ** 2 + rays[2][2] ** 2)
    width = seen.shape[1]
    for place in range(seen.shape[0] * width):
        row, column = place // width, place % width
        if seen[row, column] == 0:
            continue
        across = antialias if seen[row, column] < 0 else 1  # samples that are shaded at once
        looks = 1 if seen[row, column] < 0 else antialias * antialias
        for n in range(looks):
            s, q = row * antialias + n // antialias, column * antialias + n % antialias
            t = owner[s + across // 2, q + across // 2]
            if t < 0:
                continue
            px, py = (2 * q + across) * HALF_PIXEL, (2 * s + across) * HALF_PIXEL
            w0, w1, w2, inverse, clockwise = sample_weights(screen, triangles, inverse_depth, t, px, py)
            i, j, k = triangles[t, 0], triangles[t, 1], triangles[t, 2]
            depth, fx, fy = 1 / inverse, q + 0.5 * across, s + 0.5 * across
            dx = rays[1][0] + fx * rays[2][0] + fy * rays[3][0]
            dy = rays[1][1] + fx * rays[2][1] + fy * rays[3][1]
            dz = rays[1][2] + fx * rays[2][2] + fy * rays[3][2]
            x, y, z = rays[0][0] + depth * dx, rays[0][1] + depth * dy, rays[0][2] + depth * dz
            nx = w0 * normals[i, 0] + w1 * normals[j, 0] + w2 * normals[k, 0]
            ny = w0 * normals[i, 1] + w1 * normals[j, 1] + w2 * normals[k, 1]
            nz = w0 * normals[i, 2] + w1 * normals[j, 2] + w2 * normals[k, 2]
            # on the back of the fabric the normal points away from the eye
            unit = (-1 if clockwise else 1) / np.sqrt(max(nx * nx + ny * ny + nz * nz, 1e-12))
            nx, ny, nz = nx * unit, ny * unit, nz * unit
            toward = 1 / np.sqrt(dx * dx + dy * dy + dz * dz)
            facing = min(max(-(nx * dx + ny * dy + nz * dz) * toward, 0), 1)

            lamp = nx * axes[2][0] + ny * axes[2][1] + nz * axes[2][2]
            # read at an offset from the surface, on its lit side: within a texel a slanted surface would shadow itself
            aside = TEXELS_ASIDE / shadow_scale if lamp > 0 else -TEXELS_ASIDE / shadow_scale
            lit = _lit(shadow, shadow_box, axes, center, shadow_scale, slack, x + aside * nx, y + aside * ny, z + aside * nz)
            _, hanging, roof = _heights_at(heights, heights_box, center, height_scale, x, y)
            open_sky = 1 - ROOFED * min(max((roof - z) / ROOF_HEIGHT, 0), 1)
            direct = max(lamp, 0) * lit
            rim = SHEEN * (1 - facing) * (1 - facing) * (1 - facing)
            if surface[t] == CLOTH:
                footprint = depth * across * slope / max(facing, 0.15)
                r, g, b = _fabric(uv, values, triangles, t, w0, w1, w2, footprint, check, palette, heat, not clockwise)
                # some of the lamp's light passes through the fabric
                direct += TRANSLUCENCE * max(-lamp, 0) * lit
                # less of the sky is seen from a hollow, more from a ridge
                bent = w0 * curvature[i] + w1 * curvature[j] + w2 * curvature[k]
                open_sky *= 1 - min(max(HOLLOW * (-bent if clockwise else bent), -MOST_RIDGE), MOST_HOLLOW)
                gloss = 0.0
            else:
                base = palette[SOLIDS - 1 + surface[t]]
                r, g, b = base[0], base[1], base[2]
                # Blinn 1977: the half vector between lamp and eye, to the 32nd power
                hx, hy, hz = axes[2][0] - dx * toward, axes[2][1] - dy * toward, axes[2][2] - dz * toward
                shine = max((nx * hx + ny * hy + nz * hz) / np.sqrt(hx * hx + hy * hy + hz * hz), 0)
                for _ in range(5):
                    shine *= shine
                gloss = GLOSS * shine * lit
            sky, bounce, edge = (0.5 + 0.5 * nz) * open_sky, (0.5 - 0.5 * nz) * (1 - 0.6 * hanging), rim * open_sky
            share = across * across / (antialias * antialias)
            light[row, column, 0] += share * (r * (KEY[0] * direct + SKY[0] * sky + BOUNCE[0] * bounce) + SKY[0] * edge + gloss)
            light[row, column, 1] += share * (g * (KEY[1] * direct + SKY[1] * sky + BOUNCE[1] * bounce) + SKY[1] * edge + gloss)
            light[row, column, 2] += share * (b * (KEY[2] * direct + SKY[2] * sky + BOUNCE[2] * bounce) + SKY[2] * edge + gloss)


@kernel
def encode(light, out):
    """Linear light to sRGB bytes, (height, width, 3); NaN is black."""
    for row in range(light.shape[0]):
        for column in range(light.shape[1]):
            for c in range(3):
                value = light[row, column, c]
                out[row, column, c] = SRGB[int(min(value / BRIGHTEST, 1) * (TONES - 1) + 0.5)] if value > 0 else 0
