#version 430 core

// # Volume query, when vertices change: the copy that rectangles are computed from
//
// One invocation per coordinate of a vertex: about the local origin, rounded to single precision.
// Many devices take double precision at a thirtieth of the rate, so it is left here, once a vertex
// and not at each triangle that has the vertex.
//
// ## Resources
//
// | binding | name           | type           | unit, frame                                       |
// |---------|----------------|----------------|---------------------------------------------------|
// | 3       | vertices_world | double[3 n]    | metres                                            |
// | 10      | origin_world   | double[3]      | metres; where the local frame has its origin      |
// | 11      | vertices_local | float[3 n]     | metres about the views' local origin              |

// INSERT

layout(local_size_x = GROUP) in;

layout(std430, binding = 3) readonly buffer Vertices { double vertices_world[]; };
layout(std430, binding = 10) readonly buffer Projections {
    double origin_world[3];
    double img_from_local[];
};
layout(std430, binding = 11) writeonly buffer Rounded { float vertices_local[]; };

uniform uint n_coordinates;

void main() {
    uint stride = gl_NumWorkGroups.x * gl_WorkGroupSize.x;
    for (uint k = gl_GlobalInvocationID.x; k < n_coordinates; k += stride) {
        vertices_local[k] = float(vertices_world[k] - origin_world[k % 3u]);
    }
}
