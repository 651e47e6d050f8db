#version 430 core

// # Volume query, first pass: which triangles must be sampled
//
// One invocation per triangle. A triangle that the rectangles do not prove free is cut into
// blocks of BLOCK x BLOCK samples, and each block becomes an item for volume_sample.comp.glsl.
// NumPy reference: hull/query/bounds.py, verdicts().
//
// ## Resources (besides those of rectangle.glsl)
//
// | binding | name           | type           | unit, frame                                       |
// |---------|----------------|----------------|---------------------------------------------------|
// | 3       | vertices_local | double[3 n]    | metres about the views' local origin              |
// | 4       | faces          | int[3 n]       | vertex numbers                                    |
// | 5       | viewports      | int[n]         | samples along an edge                             |
// | 6       | items          | uvec2[]        | triangle; block row << 16 + block column          |
// | 7       | counters       | uint[]         | 4 a launch: see hull/query/compute.py             |
//
// ## Numerics
//
// float32. The rectangle is widened by a bound on all rounding (bounds.py), so a triangle is
// dropped only where no sample, as the float64 reference computes it, is inside.

// INSERT

layout(local_size_x = GROUP) in;

layout(std430, binding = 3) readonly buffer Vertices { double vertices_local[]; };
layout(std430, binding = 4) readonly buffer Faces { int faces[]; };
layout(std430, binding = 5) readonly buffer Viewports { int viewports[]; };
layout(std430, binding = 6) writeonly buffer Items { uvec2 items[]; };
layout(std430, binding = 7) buffer Counters { uint counters[]; };

uniform uint first_triangle;   // of this launch
uniform uint stop_triangle;
uniform uint item_capacity;
uniform uint launch;

vec3 vertex_local(int number) {
    return vec3(vertices_local[3 * number], vertices_local[3 * number + 1],
                vertices_local[3 * number + 2]);
}

vec3 project(uint c, vec3 point) {
    vec4 h = vec4(point, 1.0);
    return vec3(dot(cameras[c].img_from_local[0], h), dot(cameras[c].img_from_local[1], h),
                dot(cameras[c].img_from_local[2], h));
}

bool is_free(uint triangle) {
    vec3 a = vertex_local(faces[3u * triangle]);
    vec3 b = vertex_local(faces[3u * triangle + 1u]);
    vec3 c = vertex_local(faces[3u * triangle + 2u]);
    uint n_abstain = 0u;
    for (uint turn = 0u; turn < n_cameras; ++turn) {
        uint k = order[turn / 4u][turn % 4u];
        vec3 h_a = project(k, a), h_b = project(k, b), h_c = project(k, c);
        vec2 pixel_a = h_a.xy / h_a.z, pixel_b = h_b.xy / h_b.z, pixel_c = h_c.xy / h_c.z;
        uint vote = camera_vote(k, min(pixel_a, min(pixel_b, pixel_c)),
                                max(pixel_a, max(pixel_b, pixel_c)),
                                min(h_a.z, min(h_b.z, h_c.z)), max(h_a.z, max(h_b.z, h_c.z)));
        if (vote == REJECTS) return true;
        if (vote == ABSTAINS) ++n_abstain;
    }
    return keep != 0u && n_cameras - n_abstain < min_cameras;
}

void main() {
    uint stride = gl_NumWorkGroups.x * gl_WorkGroupSize.x;
    for (uint t = first_triangle + gl_GlobalInvocationID.x; t < stop_triangle; t += stride) {
        if (is_free(t)) continue;
        uint n = (uint(viewports[t]) + BLOCK - 1u) / BLOCK;   // blocks along an edge
        uint n_items = n * (n + 1u) / 2u;
        uint item = atomicAdd(counters[4u * launch + 3u], n_items);
        // The second pass is dispatched by these counters; more groups than this it strides over.
        atomicMax(counters[4u * launch], min(item + n_items, 65535u));
        for (uint row = 0u; row < n; ++row) {
            for (uint column = 0u; column < n - row; ++column, ++item) {
                if (item < item_capacity) items[item] = uvec2(t, row << 16 | column);
            }
        }
    }
}
