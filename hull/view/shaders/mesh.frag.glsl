#version 430 core

// # CAD objects: depth, normal, and which part is inside the hull
//
// Every pixel of a colliding object asks the hull: the volume query at the resolution of the
// picture, whatever the size of the triangle.
//
// ## Resources
//
// Those of hull.common.glsl, and
//
// | output | name   | type | unit, frame                                                      |
// |--------|--------|------|------------------------------------------------------------------|
// | 0      | depth  | R32F | metres along `forward`                                           |
// | 1      | normal | vec4 | towards the eye, local frame; w = kind                           |
//
// Kinds, the same in hull/view/paint.py: 1 free, 2 of an object that collides, 3 a triangle with
// collision points, 4 inside the hull. To the first three is added up to 0.4 where lamps of the scene
// do not reach. Where warmth is not negative, the kind is HEATED plus it instead, unless it is 4.

// INSERT

in vec3 mesh_point;
flat in float mesh_kind;
in float mesh_warmth;   // how near something came, 0 to 1; negative where that is not shown

layout(location = 0) out float depth;
layout(location = 1) out vec4 normal;

uniform vec3 eye, forward;
uniform bool parallel;
uniform vec3 box_low, box_high;  // contains the hull, metres, local frame
uniform bool inside_only;   // draw nothing but what is inside the hull

const float HEATED = 5.0;   // the same in compose.frag.glsl

void main() {
    float kind = mesh_kind;
    bool near_hull = all(greaterThan(mesh_point, box_low)) && all(lessThan(mesh_point, box_high));
    if (kind > 1.5 && near_hull && hull_contains(mesh_point)) kind = 4.0;
    if (inside_only && kind < 3.5) discard;
    if (kind < 3.5 && mesh_warmth >= 0.0) kind = HEATED + clamp(mesh_warmth, 0.0, 0.995);

    vec3 across = cross(dFdx(mesh_point), dFdy(mesh_point));
    float size = length(across);
    vec3 towards_eye = parallel ? -forward : normalize(eye - mesh_point);
    vec3 n = size > 0.0 ? across / size : towards_eye;
    depth = dot(mesh_point - eye, forward);
    normal = vec4(dot(n, towards_eye) < 0.0 ? -n : n, kind);
}
