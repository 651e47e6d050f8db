#version 430 core

// # Lines, dots and faces over the scene
//
// Vertices come from hull/view/strokes.py, in clip coordinates whose w is the depth in metres.

in vec4 clip;
in vec4 colour;
in vec2 place;        // in a dot, -1 to 1; elsewhere 0
in float when_hidden; // opacity left behind something

out vec4 stroke_colour;
out vec2 stroke_place;
out float stroke_hidden;
out float stroke_depth;

void main() {
    gl_Position = clip;
    stroke_colour = colour;
    stroke_place = place;
    stroke_hidden = when_hidden;
    stroke_depth = clip.w;
}
