#version 430 core

// # The hull's normals, smoothed
//
// The hull is a patchwork of cones, each from one camera; between them the normal jumps with the
// noise of the silhouettes. A blur across the picture that stops at steps in depth makes one body
// of it. For the eye only: depth is left as it is.
//
// | binding | name        | type      | unit, frame                        |
// |---------|-------------|-----------|------------------------------------|
// | unit 2  | hull_depth  | sampler2D | metres along the view              |
// | unit 3  | hull_normal | sampler2D | outward, local frame; w = 1 on it  |

layout(location = 0) out vec4 normal;

layout(binding = 2) uniform sampler2D hull_depth;
layout(binding = 3) uniform sampler2D hull_normal;

uniform ivec2 along;     // (1, 0), then (0, 1)
uniform float sigma_px;
uniform float step_m;    // depth that counts as a step
uniform int reach;       // taps on either side

void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    ivec2 last = textureSize(hull_depth, 0) - 1;
    vec4 own = texelFetch(hull_normal, here, 0);
    normal = vec4(0.0);
    if (own.w == 0.0) return;
    float own_depth = texelFetch(hull_depth, here, 0).r;
    vec3 sum = vec3(0.0);
    float stride = 3.0 * sigma_px / float(reach);
    for (int k = -reach; k <= reach; ++k) {
        ivec2 there = clamp(here + ivec2(round(float(k) * stride)) * along, ivec2(0), last);
        vec4 other = texelFetch(hull_normal, there, 0);
        float apart = (texelFetch(hull_depth, there, 0).r - own_depth) / step_m;
        float offset = float(k) * 3.0 / float(reach);
        if (other.w > 0.0 && abs(apart) < 4.0)
            sum += other.xyz * exp(-0.5 * (offset * offset + apart * apart));
    }
    normal = vec4(length(sum) > 0.0 ? normalize(sum) : own.xyz, 1.0);
}
