#version 430 core

// # Volume query, second pass: which triangles must be sampled
//
// One invocation per triangle of the clusters that volume_cluster.comp.glsl left open. A triangle
// proved free is dropped, one proved full is one hit, and the others are cut into blocks of
// BLOCK x BLOCK samples, each of which becomes an item for volume_sample.comp.glsl.
// NumPy reference: hull/query/bounds.py, verdicts().
//
// ## Resources (besides those of rectangle.glsl)
//
// | binding | name           | type           | unit, frame                                       |
// |---------|----------------|----------------|---------------------------------------------------|
// | 2       | open_clusters  | uint[]         | cluster numbers                                   |
// | 4       | faces          | int[3 n]       | vertex numbers                                    |
// | 5       | viewports      | int[n]         | samples along an edge                             |
// | 6       | items          | uvec2[]        | triangle; block row << 16 + block column          |
// | 7       | counters       | uint[]         | 8 a launch: see hull/query/compute.py             |
// | 8       | hits           | uvec4[]        | see hull/query/compute.py                         |
// | 11      | vertices_local | float[3 n]     | metres about the views' local origin              |
//
// ## Numerics
//
// float32. The rectangle is widened by a bound on all rounding (bounds.py), so a triangle is
// dropped only where no sample, as the float64 reference computes it, is inside.

// INSERT

layout(local_size_x = GROUP) in;

layout(std430, binding = 2) readonly buffer OpenClusters { uint open_clusters[]; };
layout(std430, binding = 4) readonly buffer Faces { int faces[]; };
layout(std430, binding = 5) readonly buffer Viewports { int viewports[]; };
layout(std430, binding = 6) writeonly buffer Items { uvec2 items[]; };
layout(std430, binding = 7) buffer Counters { uint counters[]; };
layout(std430, binding = 8) writeonly buffer Hits { uvec4 hits[]; };
layout(std430, binding = 11) readonly buffer Rounded { float vertices_local[]; };

uniform uint first_triangle;   // of this launch
uniform uint stop_triangle;
uniform uint item_capacity;
uniform uint hit_capacity;
uniform uint hit_counter;      // index into counters
uniform uint launch;
uniform uint mesh;

shared uint n_items, n_full, first_item, first_full;

vec3 vertex_local(int number) {
    return vec3(vertices_local[3 * number], vertices_local[3 * number + 1],
                vertices_local[3 * number + 2]);
}

uint triangle_verdict(uint triangle) {
    vec3 a = vertex_local(faces[3u * triangle]);
    vec3 b = vertex_local(faces[3u * triangle + 1u]);
    vec3 c = vertex_local(faces[3u * triangle + 2u]);
    vec4 reach_m = vec4(max(abs(a), max(abs(b), abs(c))), 1.0);
    uint n_accept = 0u, n_abstain = 0u, n_withhold = 0u;
    for (uint turn = 0u; turn < n_cameras; ++turn) {
        uint k = order[turn / 4u][turn % 4u];
        Extent extent = NOWHERE;
        widen_by_point(extent, k, a);
        widen_by_point(extent, k, b);
        widen_by_point(extent, k, c);
        uint vote = camera_vote(k, extent, pads_of(k, reach_m));
        if (vote == REJECTS) return FREE;
        n_accept += uint(vote == ACCEPTS);
        n_abstain += uint(vote == ABSTAINS);
        n_withhold += uint(vote == WITHHOLDS);
    }
    return verdict(n_accept, n_abstain, n_withhold);
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    const uint parts = CLUSTER / GROUP;   // work groups a cluster
    uint n_parts = parts * counters[8u * launch + 3u];
    for (uint part = gl_WorkGroupID.x; part < n_parts; part += gl_NumWorkGroups.x) {
        uint triangle = open_clusters[part / parts] * CLUSTER + part % parts * GROUP + lane;
        bool is_asked = first_triangle <= triangle && triangle < stop_triangle;
        uint found = is_asked ? triangle_verdict(triangle) : FREE;
        if (lane == 0u) n_items = n_full = 0u;
        barrier();
        uint place = 0u, n_edge = 0u;   // blocks along an edge
        if (found == OPEN) {
            n_edge = (uint(viewports[triangle]) + BLOCK - 1u) / BLOCK;
            place = atomicAdd(n_items, n_edge * (n_edge + 1u) / 2u);
        } else if (found == FULL) {
            place = atomicAdd(n_full, 1u);
        }
        barrier();
        if (lane == 0u && n_items > 0u) {
            first_item = atomicAdd(counters[8u * launch + 7u], n_items);
            // The next pass is dispatched by this counter; beyond these groups it strides.
            atomicMax(counters[8u * launch + 4u], min(first_item + n_items, MAX_GROUPS));
        }
        if (lane == 0u && n_full > 0u) first_full = atomicAdd(counters[hit_counter], n_full);
        barrier();
        if (found == FULL && first_full + place < hit_capacity) {
            hits[first_full + place] = uvec4(triangle, WHOLE, 1u, mesh);
        }
        uint item = first_item + place;
        for (uint row = 0u; row < n_edge; ++row) {
            for (uint column = 0u; column < n_edge - row; ++column, ++item) {
                if (item < item_capacity) items[item] = uvec2(triangle, row << 16 | column);
            }
        }
        barrier();
    }
}
