"""Shaders of the scene, in GLSL. Light is linear; images and textures hold its square root (a gamma of 2)."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from ds_sim_panda.scene.graphics import panda
from ds_sim_panda.scene.parameters import (
    HAZE,
    HORIZON,
    LINE_WEAR,
    LINE_WIDTH,
    VERGE_WIDTH,
    WHITE,
    YELLOW,
)
from ds_sim_panda.scene.sunlight import skylight, sun_direction, sunlight

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
    float lit = 1.0 - texture(shadows, (place.xy - shadow_frame.xy) * shadow_frame.z).r;
    return SKYLIGHT + lit * SUNLIGHT;
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
uniform float half_width;
void main() {
    float u = coordinates.x, w = pixel_width();
    vec4 surface = texture(asphalt, place.xy * 0.25);
    vec3 c = linear(surface.rgb) * (0.4 + 1.2 * broad(0.043));
    float worn = 1.0 - LINE_WEAR * surface.a;
    // Shares of the part of the pixel that lies on the road; the rest shows what is below.
    float inside = max(covered(u, w, -half_width, half_width), 1e-3);
    float white = covered(abs(u), w, half_width - LINE_WIDTH, half_width) / inside;
    float yellow = covered(u, w, -0.5 * LINE_WIDTH, 0.5 * LINE_WIDTH) / inside;
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
    colour = vec4(texture(sky, coordinates.xy).rgb, 1.0);
}
"""

_FLAT = """
void main() {
    colour = vec4(1.0);
}
"""

_FRAGMENTS = {
    "ground": _GROUND,
    "far ground": "#define FAR\n" + _GROUND,
    "verge": _VERGE,
    "road": _ROAD,
    "solid": _SOLID,
    "sky": _SKY,
    "flat": _FLAT,
}


@cache
def shader(name: str) -> Any:
    """Panda3D's shader of a kind of surface: ground, far ground, verge, road, solid, sky, or flat white."""
    core = panda()
    return core.Shader.make(core.Shader.SL_GLSL, _filled(_VERTEX), _filled(_COMMON + _FRAGMENTS[name]))


def _filled(source: str) -> str:
    """Write the scene's constants into a source."""
    constants: dict[str, float | Sequence[float]] = {
        "MOST_LIGHT": MOST_LIGHT,
        "HAZE": HAZE,
        "HORIZON": HORIZON,
        "SKYLIGHT": skylight().tolist(),
        "SUNLIGHT": (sunlight() * sun_direction()[2]).tolist(),
        "VERGE_WIDTH": VERGE_WIDTH,
        "LINE_WIDTH": LINE_WIDTH,
        "LINE_WEAR": LINE_WEAR,
        "WHITE": WHITE,
        "YELLOW": YELLOW,
    }
    lines = [
        f"const float {name} = {value!r};" if isinstance(value, float)
        else f"const vec3 {name} = vec3({', '.join(map(repr, value))});"
        for name, value in constants.items()
    ]  # fmt: skip
    version, rest = source.strip().split("\n", 1)
    return "\n".join((version, *lines, rest))
