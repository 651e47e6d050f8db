#version 430 core

// # CAD objects: from the local frame to the picture

in vec3 point;   // metres, local frame
in float kind;   // see mesh.frag.glsl
in float warmth; // likewise

uniform mat4 clip_from_local;

out vec3 mesh_point;
flat out float mesh_kind;
out float mesh_warmth;

void main() {
    mesh_point = point;
    mesh_kind = kind;
    mesh_warmth = warmth;
    gl_Position = clip_from_local * vec4(point, 1.0);
}
