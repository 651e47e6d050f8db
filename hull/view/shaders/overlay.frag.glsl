#version 430 core

// # CAD in a camera's recorded image
//
// | output | name  | type | unit                                                                |
// |--------|-------|------|---------------------------------------------------------------------|
// | 0      | drawn | vec4 | kind (as in mesh.frag.glsl), brightness 0 to 1, depth in metres, 0  |

in vec3 surface;
flat in float surface_kind;
in float surface_nearness;

layout(location = 0) out vec4 drawn;

void main() {
    vec3 across = cross(dFdx(surface), dFdy(surface));
    float size = length(across);
    vec3 n = size > 0.0 ? across / size : vec3(0.0, 0.0, -1.0);
    if (n.z > 0.0) n = -n;
    float light = max(dot(n, normalize(vec3(-0.4, -0.7, -0.8))), 0.0);
    drawn = vec4(surface_kind, 0.25 + 0.75 * light, 1.0 / surface_nearness, 0.0);
}
