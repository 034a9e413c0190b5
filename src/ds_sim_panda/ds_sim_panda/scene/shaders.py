# SPDX-License-Identifier: Apache-2.0
"""Shaders of the scene, in GLSL. Light is linear; images and textures hold its square root (a gamma of 2)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from ds_sim_panda.scene import parameters
from ds_sim_panda.scene.graphics import panda
from ds_sim_panda.scene.setting import own_daylight

MOST_LIGHT = 1.5
"""Light that the largest vertex colour stands for, as a share of daylight on level ground."""

_VERTEX = """
#version 130
in vec4 p3d_Vertex;
in vec3 p3d_MultiTexCoord0;
in vec4 p3d_Color;
uniform mat4 p3d_ModelViewProjectionMatrix, p3d_ModelViewMatrix, p3d_ModelMatrix, p3d_ViewMatrixInverse;
out vec3 seen, place, coordinates;
out vec3 light;
out float eye_height, arriving;
void main() {
    gl_Position = p3d_ModelViewProjectionMatrix * p3d_Vertex;
    seen = (p3d_ModelViewMatrix * p3d_Vertex).xyz;
    place = (p3d_ModelMatrix * p3d_Vertex).xyz;
    coordinates = p3d_MultiTexCoord0;
    eye_height = p3d_ViewMatrixInverse[3].z;
    arriving = exp(-HAZE * length(seen));
    light = p3d_Color.rgb * p3d_Color.rgb * MOST_LIGHT;
}
"""

# A surface that hides what is drawn later and is as far away, within a distance; beyond it, it lies behind.
_HIDING_VERTEX = """
#version 130
in vec4 p3d_Vertex;
uniform mat4 p3d_ModelViewProjectionMatrix;
void main() {
    gl_Position = p3d_ModelViewProjectionMatrix * p3d_Vertex;
    gl_Position.z += 1e-4 * (gl_Position.w - HIDING_WITHIN);
}
"""

_COMMON = """
#version 130
in vec3 seen, place, coordinates;
in vec3 light;
in float eye_height, arriving;
out vec4 colour;
vec3 linear(vec3 stored) { return stored * stored; }
// The share exp(-HAZE * distance) of a colour arrives; the rest is the colour of the horizon.
vec4 hazed(vec3 c, float opacity) {
    return vec4(sqrt(mix(HORIZON, c, exp(-HAZE * length(seen)))), opacity);
}
uniform sampler2D shadows;
uniform vec3 shadow_frame;
vec3 daylight() {
    vec4 dark = texture(shadows, (place.xy - shadow_frame.xy) * shadow_frame.z);
    float lit = 1.0 - dark.r;
#ifdef SETTING
    return min(SKYLIGHT + lit * SUNLIGHT, mix(SKYLIGHT + SUNLIGHT, SHADE, dark.g));
#else
    return SKYLIGHT + lit * SUNLIGHT;
#endif
}
uniform sampler2D patches;
// Slow variation from place to place, 0.5 on average; frequency: repetitions per metre.
float broad(float frequency) {
    float stored = texture(patches, place.xy * frequency).r;
    return stored * stored;
}
// Width of a pixel across the road, m.
float pixel_width() { return max(length(vec2(dFdx(coordinates.x), dFdy(coordinates.x))), 1e-4); }
// Share of a pixel at u, w wide, that lies between two borders.
float covered(float u, float w, float low, float high) {
    return clamp((min(u + 0.5 * w, high) - max(u - 0.5 * w, low)) / w, 0.0, 1.0);
}
"""

_GROUND = """
uniform sampler2D grass;
void main() {
    vec3 c = linear(texture(grass, place.xy * 0.125).rgb);
    c *= 2.0 * broad(0.0171);
#ifdef FAR
    // A pixel on the horizon shows the sky behind it in part.
    float below = eye_height / length(seen);
    float opacity = clamp(0.5 + below / length(vec2(dFdx(below), dFdy(below))), 0.0, 1.0);
#else
    float opacity = 1.0;
#endif
    colour = hazed(c * daylight(), opacity);
}
"""

_VERGE = """
uniform sampler2D gravel;
uniform float half_width;
void main() {
    float u = abs(coordinates.x), w = pixel_width();
    float ragged = 0.5 * texture(patches, place.xy * 0.11).g;
    float inside = covered(u, max(w, 0.12), -1e3, half_width + VERGE_WIDTH - ragged);
    colour = hazed(linear(texture(gravel, place.xy * 0.25).rgb) * daylight(), inside);
}
"""

_ROAD = """
uniform sampler2D asphalt;
uniform float half_width, two_lanes;
#ifdef SETTING
uniform sampler2D bare, repaired;
uniform vec2 road_frame;
#endif
void main() {
    float u = coordinates.x, w = pixel_width();
    vec4 surface = texture(asphalt, place.xy * 0.25);
    vec3 c = linear(surface.rgb) * (0.4 + 1.2 * broad(0.043));
    float worn = 1.0 - LINE_WEAR * surface.a;
    // Shares of the part of the pixel that lies on the road; the rest shows what is below.
    float inside = max(covered(u, w, -half_width, half_width), 1e-3);
    float white = covered(abs(u), w, half_width - LINE_WIDTH, half_width) / inside;
    float yellow = two_lanes * covered(u, w, -0.5 * LINE_WIDTH, 0.5 * LINE_WIDTH) / inside;
#ifdef SETTING
    vec2 along = vec2((coordinates.y - road_frame.x) * road_frame.y, 0.5);
    c = PAVEMENT * (1.0 + GRAIN * (c / ASPHALT - 1.0));
    // A distant pixel is long along the road: four samples of a quarter of it keep the sides of patches crisp.
    vec2 at = vec2(along.x, 0.5 + 0.5 * u / half_width), right = dFdx(at), down = dFdy(at);
    float new = 0.0;
    for (int part = 0; part < 4; part++)
        new += 0.25 * textureGrad(repaired, at + (0.25 * float(part) - 0.375) * down, right, 0.25 * down).r;
    c *= 1.0 - (1.0 - NEW_ASPHALT) * new;
    // Wear is 0.5 on average.
    worn = PAINT_LEFT * worn + BLOTCHES * (0.5 - surface.a);
    vec3 gone = texture(bare, along).rgb;
    white *= 1.0 - (u < 0.0 ? gone.r : gone.b);
    yellow *= 1.0 - gone.g;
#endif
    c = mix(mix(c, WHITE, white * worn), YELLOW, yellow * worn);
    colour = hazed(c * daylight(), inside);
}
"""

_SOLID = """
uniform sampler2DArray materials;
void main() {
    colour = vec4(sqrt(mix(HORIZON, linear(texture(materials, coordinates).rgb) * light, arriving)), 1.0);
}
"""

_SKY = """
uniform sampler2D sky;
void main() {
    vec3 seen_sky = texture(sky, coordinates.xy).rgb;
#ifdef SETTING
    // The way through the layer of fog overhead.
    float rise = (place.z - eye_height) / length(seen);
    float clear = exp(-FOG_DEPTH / max(rise, 1e-4));
    seen_sky = sqrt(mix(HORIZON, linear(seen_sky), clear));
#endif
    colour = vec4(seen_sky, 1.0);
}
"""

_FLAT = """
void main() {
    colour = vec4(1.0);
}
"""

# Shadows of conditions, seen from above; along the road, m, their sides are frayed.
_SHADE = """
uniform sampler2D shaded;
uniform vec2 road_frame;
void main() {
    float frayed = SHADE_FRAYING * (linear(texture(patches, place.xy * 0.05).rgb).g - 0.5);
    float along = (coordinates.y + frayed - road_frame.x) * road_frame.y;
    colour = vec4(texture(shaded, vec2(along, 0.5)).r);
}
"""

_SETTING_SCALARS = ("HAZE", "FOG_DEPTH", "GRAIN", "NEW_ASPHALT", "PAINT_LEFT", "BLOTCHES")
_SETTING_COLOURS = ("HORIZON", "SKYLIGHT", "SUNLIGHT", "SHADE", "PAVEMENT")
"""Inputs of the shaders of a world with a setting."""

_CONSTANTS = (
    *("HAZE", "HORIZON", "VERGE_WIDTH", "LINE_WIDTH", "LINE_WEAR", "WHITE", "YELLOW", "ASPHALT", "SHADE_FRAYING"),
    "HIDING_WITHIN",
)
"""Constants of `parameters` that shaders read."""
_FRAGMENTS = {
    "ground": _GROUND,
    "far ground": "#define FAR\n" + _GROUND,
    "verge": _VERGE,
    "road": _ROAD,
    "solid": _SOLID,
    "sky": _SKY,
    "flat": _FLAT,
    "hiding": _FLAT,
    "shade": _SHADE,
}


@cache
def shader(name: str, *, setting: bool = False) -> Any:
    """Panda3D's shader of a kind of surface, of `_FRAGMENTS`; with a setting, its `shader_inputs` are uniforms."""
    core = panda()
    vertex = _HIDING_VERTEX if name == "hiding" else _VERTEX
    sources = (_filled(source, setting=setting) for source in (vertex, _COMMON + _FRAGMENTS[name]))
    return core.Shader.make(core.Shader.SL_GLSL, *sources)


def _filled(source: str, *, setting: bool) -> str:
    """Write the scene's constants into a source."""
    daylight = own_daylight()
    constants: dict[str, float | Sequence[float]] = {
        **{name: getattr(parameters, name) for name in _CONSTANTS},
        "MOST_LIGHT": MOST_LIGHT,
        "SKYLIGHT": list(daylight.sky),
        "SUNLIGHT": daylight.sun_on_ground.tolist(),
    }
    lines = [
        f"const float {name} = {value!r};"
        if isinstance(value, float)
        else f"const vec3 {name} = vec3({', '.join(map(repr, value))});"
        for name, value in constants.items()
        if not (setting and name in (*_SETTING_SCALARS, *_SETTING_COLOURS))
    ]
    if setting:
        lines = [
            "#define SETTING",
            f"uniform float {', '.join(_SETTING_SCALARS)};",
            f"uniform vec3 {', '.join(_SETTING_COLOURS)};",
            *lines,
        ]
    version, rest = source.strip().split("\n", 1)
    return "\n".join((version, *lines, rest))
