#version 430 core

// # CAD in a camera's recorded image
//
// Vertices were taken through the lens beforehand: x and y in pixels, pixel centre 0.5, and depth
// in metres.

in vec3 place;
in float kind;   // see overlay.frag.glsl

uniform vec2 size_px;
uniform vec2 range_m;
uniform float focal_px;

out vec3 surface;
flat out float surface_kind;
out float surface_nearness;

void main() {
    surface = vec3((place.xy - 0.5 * size_px) / focal_px * place.z, place.z);
    surface_kind = kind;
    // Inverse depth is what runs straight across an image.
    surface_nearness = 1.0 / place.z;
    float nearness = (surface_nearness - 1.0 / range_m.y) / (1.0 / range_m.x - 1.0 / range_m.y);
    gl_Position = vec4(2.0 * place.xy / size_px - 1.0, 1.0 - 2.0 * nearness, 1.0);
}
