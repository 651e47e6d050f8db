#version 430 core

// # Volume query, when vertices change: the boxes around clusters
//
// One work group per cluster, a run of CLUSTER consecutive triangles: the smallest box along the
// axes of the local frame that holds them.
//
// ## Resources
//
// | binding | name           | type           | unit, frame                                       |
// |---------|----------------|----------------|---------------------------------------------------|
// | 1       | boxes          | float[6 n]     | metres, local frame: all lower x, all lower y, .. |
// | 4       | faces          | int[3 n]       | vertex numbers                                    |
// | 11      | vertices_local | float[3 n]     | metres about the views' local origin              |
//
// ## Numerics
//
// The vertices were rounded to single precision, in any direction. The proof of bounds.py asks for
// no more: it allows corners of the convex hull to be rounded so, and each rounded vertex lies in
// its cluster's box, hence in the convex hull of the box's eight corners.

// INSERT

layout(local_size_x = GROUP) in;

layout(std430, binding = 1) writeonly buffer Boxes { float boxes[]; };
layout(std430, binding = 4) readonly buffer Faces { int faces[]; };
layout(std430, binding = 11) readonly buffer Rounded { float vertices_local[]; };

uniform uint n_triangles;
uniform uint n_clusters;

// Of each lane: the lower corner, then the upper corner, negated so that all six are minima.
shared float ends[6 * GROUP];

void main() {
    uint lane = gl_LocalInvocationID.x;
    for (uint cluster = gl_WorkGroupID.x; cluster < n_clusters; cluster += gl_NumWorkGroups.x) {
        vec3 lower = vec3(3e38), minus_upper = vec3(3e38);
        uint stop = min(n_triangles, (cluster + 1u) * CLUSTER);
        for (uint t = cluster * CLUSTER + lane; t < stop; t += GROUP) {
            for (uint k = 0u; k < 3u; ++k) {
                int number = 3 * faces[3u * t + k];
                vec3 vertex = vec3(vertices_local[number], vertices_local[number + 1],
                                   vertices_local[number + 2]);
                lower = min(lower, vertex);
                minus_upper = min(minus_upper, -vertex);
            }
        }
        for (uint axis = 0u; axis < 3u; ++axis) {
            ends[6u * lane + axis] = lower[axis];
            ends[6u * lane + 3u + axis] = minus_upper[axis];
        }
        barrier();
        if (lane < 6u) {
            float least = ends[lane];
            for (uint other = 1u; other < GROUP; ++other) {
                least = min(least, ends[6u * other + lane]);
            }
            boxes[lane * n_clusters + cluster] = lane < 3u ? least : -least;
        }
        barrier();
    }
}
