#version 430 core

// # Volume query, first pass: which clusters must be looked into
//
// One invocation per cluster, a run of CLUSTER consecutive triangles. A cluster whose box is proved
// free is dropped, one proved full is one hit, and the others are left to volume_reject.comp.glsl.
// NumPy reference: hull/query/bounds.py, verdicts().
//
// ## Resources (besides those of rectangle.glsl)
//
// | binding | name           | type           | unit, frame                                       |
// |---------|----------------|----------------|---------------------------------------------------|
// | 1       | boxes          | float[6 n]     | metres, local frame: see volume_bounds.comp.glsl  |
// | 2       | open_clusters  | uint[]         | cluster numbers                                   |
// | 7       | counters       | uint[]         | 8 a launch: see hull/query/compute.py             |
// | 8       | hits           | uvec4[]        | see hull/query/compute.py                         |
//
// ## Numerics
//
// float32. Each sample is a convex combination of the eight corners of its cluster's box, so the
// proof of bounds.py holds for the box as it does for a triangle: a cluster is dropped only where
// no sample, as the float64 reference computes it, is inside.

// INSERT

layout(local_size_x = GROUP) in;

layout(std430, binding = 1) readonly buffer Boxes { float boxes[]; };
layout(std430, binding = 2) writeonly buffer OpenClusters { uint open_clusters[]; };
layout(std430, binding = 7) buffer Counters { uint counters[]; };
layout(std430, binding = 8) writeonly buffer Hits { uvec4 hits[]; };

uniform uint first_triangle;   // of this launch, which may begin and end within a cluster
uniform uint stop_triangle;
uniform uint n_clusters;       // of the mesh
uniform uint hit_capacity;
uniform uint hit_counter;      // index into counters
uniform uint launch;
uniform uint mesh;

shared uint n_open, n_full, first_open, first_full;

uint box_verdict(uint cluster) {
    vec3 ends[2];
    for (uint axis = 0u; axis < 3u; ++axis) {
        ends[0][axis] = boxes[axis * n_clusters + cluster];
        ends[1][axis] = boxes[(3u + axis) * n_clusters + cluster];
    }
    vec4 reach_m = vec4(max(abs(ends[0]), abs(ends[1])), 1.0);
    uint n_accept = 0u, n_abstain = 0u, n_withhold = 0u;
    for (uint turn = 0u; turn < n_cameras; ++turn) {
        uint k = order[turn / 4u][turn % 4u];
        Extent extent = NOWHERE;
        for (uint corner = 0u; corner < 8u; ++corner) {
            widen_by_point(extent, k, vec3((corner & 1u) == 0u ? ends[0].x : ends[1].x,
                                           (corner & 2u) == 0u ? ends[0].y : ends[1].y,
                                           (corner & 4u) == 0u ? ends[0].z : ends[1].z));
        }
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
    uint start = first_triangle / CLUSTER, stop = (stop_triangle + CLUSTER - 1u) / CLUSTER;
    uint stride = gl_NumWorkGroups.x * GROUP;
    for (uint group = start + gl_WorkGroupID.x * GROUP; group < stop; group += stride) {
        uint cluster = group + lane;
        uint found = cluster < stop ? box_verdict(cluster) : FREE;
        if (lane == 0u) n_open = n_full = 0u;
        barrier();
        uint place = 0u;
        if (found == OPEN) place = atomicAdd(n_open, 1u);
        else if (found == FULL) place = atomicAdd(n_full, 1u);
        barrier();
        if (lane == 0u && n_open > 0u) {
            first_open = atomicAdd(counters[8u * launch + 3u], n_open);
            // The next pass is dispatched by this counter; beyond these groups it strides.
            atomicMax(counters[8u * launch],
                      min((first_open + n_open) * (CLUSTER / GROUP), MAX_GROUPS));
        }
        if (lane == 0u && n_full > 0u) first_full = atomicAdd(counters[hit_counter], n_full);
        barrier();
        if (found == OPEN) {
            open_clusters[first_open + place] = cluster;
        } else if (found == FULL && first_full + place < hit_capacity) {
            uint first = max(first_triangle, cluster * CLUSTER);
            uint end = min(stop_triangle, (cluster + 1u) * CLUSTER);
            hits[first_full + place] = uvec4(first, WHOLE, end - first, mesh);
        }
        barrier();
    }
}
