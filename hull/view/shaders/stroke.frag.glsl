#version 430 core

// # Lines, dots and faces over the scene
//
// | binding | name       | type      | unit                                     |
// |---------|------------|-----------|------------------------------------------|
// | unit 2  | hull_depth | sampler2D | metres along the view; of the hull       |
// | unit 4  | mesh_depth | sampler2D | the same, of the nearest object          |

in vec4 stroke_colour;
in vec2 stroke_place;
in float stroke_hidden;
in float stroke_depth;

layout(location = 0) out vec4 colour;

layout(binding = 2) uniform sampler2D hull_depth;
layout(binding = 4) uniform sampler2D mesh_depth;

const float SLACK = 2e-3;  // of the depth: a line on a surface is not behind it

void main() {
    if (dot(stroke_place, stroke_place) > 1.0) discard;
    ivec2 here = ivec2(gl_FragCoord.xy);
    float scene = min(texelFetch(hull_depth, here, 0).r, texelFetch(mesh_depth, here, 0).r);
    bool hidden = stroke_depth * (1.0 - SLACK) > scene;
    colour = vec4(stroke_colour.rgb, stroke_colour.a * (hidden ? stroke_hidden : 1.0));
}
