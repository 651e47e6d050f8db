#version 430 core

// # Volume query, third pass: which samples are inside
//
// One work group per item, a block of at most BLOCK x BLOCK samples of one triangle. First each
// camera's rectangle around the block is asked (rectangle.glsl), then the samples, in the cameras
// that stay undecided. Samples inside are bits of the block's rows; the runs of each row are
// appended to `hits`, in no particular order.
// NumPy reference: hull/query/reference.py, contains_points().
//
// ## References
//
// * Lok, Naik, Whitton and Brooks, Incorporating Dynamic Real Objects into Immersive Virtual
//   Environments, 2003, sections 3.2 and 4.2.4.
//
// ## Resources (besides those of rectangle.glsl)
//
// | binding | name           | type           | unit, frame                                       |
// |---------|----------------|----------------|---------------------------------------------------|
// | 3       | vertices_world | double[3 n]    | metres                                            |
// | 4       | faces          | int[3 n]       | vertex numbers                                    |
// | 5       | viewports      | int[n]         | samples along an edge                             |
// | 6       | items          | uvec2[]        | triangle; block row << 16 + block column          |
// | 7       | counters       | uint[]         | 8 a launch: see hull/query/compute.py             |
// | 8       | hits           | uvec4[]        | see hull/query/compute.py                         |
// | 9       | masks          | uint[]         | 1 bit a pixel, row-major, lowest bit first; then  |
// |         |                |                | recorded pixels, of cameras with not all of them  |
// | 10      | origin_world   | double[3]      | metres; where the local frame has its origin      |
// |         | img_from_local | double[12 n]   | the cameras' projections again, row-major         |
//
// ## Numerics
//
// A pixel computed plainly in float32 would be off by some 1e-3 px at 1600 px. Instead the block's
// first sample and the steps to its neighbours are projected in float64, once per block and camera:
//
//     pixel(di, dj) = p + (di A + dj B) / (1 + di C + dj D),   in float32 about p, where
//     A = (step_i.xy - p step_i.z) / depth,   C = step_i.z / depth,   likewise B and D for step_j,
//
// so that rounding scales with the block's extent in the image and not with the image's. With
// u = 2^-24, N = n (|A| + |B|) pixels and W = 1 + n (|C| + |D|) for n steps, and w the smallest
// denominator, the numerator is off by at most 3 u N, the denominator by 4 u W, and the division
// by 5 u of its result; adding the fraction of p rounds twice more. The pixel is off by at most
//
//     u ((N / w) (9 + 4 W / w) + 3).
//
// Where that bound (taken with 12 and 6) exceeds MAX_ERROR_PX, about 300 px of extent, or a corner
// is not safely in front of the camera, the samples are projected in float64 instead. So the
// result can differ from the reference only for samples that project within 1e-3 px of a pixel
// edge (tested in tests/property/test_query_engines.py).
//
// The rectangle around the block comes from the same projections, rounded to float32: the pads
// cover 22 u B_k of bounds.py for that. With it w is off by 3 % at most, since a corner safely in
// front is more than 600 u B_z deep.
//
// ## Memory
//
// What a work group shares takes 31 KiB for 256 cameras; every device offers 32.

// INSERT

layout(local_size_x = GROUP) in;

layout(std430, binding = 3) readonly buffer Vertices { double vertices_world[]; };
layout(std430, binding = 4) readonly buffer Faces { int faces[]; };
layout(std430, binding = 5) readonly buffer Viewports { int viewports[]; };
layout(std430, binding = 6) readonly buffer Items { uvec2 items[]; };
layout(std430, binding = 7) buffer Counters { uint counters[]; };
layout(std430, binding = 8) writeonly buffer Hits { uvec4 hits[]; };
layout(std430, binding = 9) readonly buffer Masks { uint masks[]; };
layout(std430, binding = 10) readonly buffer Projections {
    double origin_world[3];
    double img_from_local[];
};

uniform uint item_capacity;
uniform uint hit_capacity;
uniform uint hit_counter;   // index into counters
uniform uint launch;
uniform uint mesh;

const float MAX_ERROR_PX = 4e-4;

// The block in space: its first sample and the steps to its neighbours, metres, local frame. Known
// to the invocations that ask a camera; the others need no double precision.
dvec3 position, step_i, step_j;
vec4 reach_m;   // of its triangle: see pads_of()

// The block in one camera's image, about its first sample; without `is_single` only that, and the
// rows of the projection stand in `projected`.
struct Look {
    vec2 fraction_px;       // of the first sample's pixel
    ivec2 whole_px;
    vec2 along_i, along_j;  // A, B
    vec2 depth_steps;       // C, D
    bool is_single;
};

shared Look looks[N_CAMERAS];
shared double projected[9 * N_CAMERAS];
shared uint undecided[N_CAMERAS];
shared uint n_undecided, n_accept, n_abstain, n_withhold, n_reject;
shared uint rows[BLOCK];        // bit di of rows[dj]: sample (di, dj) of the block is inside
shared uint run_places[BLOCK];  // where the runs of a row go, among those of the block
shared uint n_runs, first_run;

dvec3 vertex_local(uint triangle, int corner) {
    int number = 3 * faces[3u * triangle + uint(corner)];
    return dvec3(vertices_world[number] - origin_world[0],
                 vertices_world[number + 1] - origin_world[1],
                 vertices_world[number + 2] - origin_world[2]);
}

void place_block(uint triangle, int u, ivec2 first) {
    dvec3 a = vertex_local(triangle, 0), b = vertex_local(triangle, 1), c = vertex_local(triangle, 2);
    reach_m = vec4(vec3(max(abs(a), max(abs(b), abs(c)))), 1.0);
    if (u == 1) {   // the centroid alone
        position = (a + b + c) / 3.0LF;
        step_i = step_j = dvec3(0.0LF);
    } else {
        double per_edge = 1.0LF / double(u - 1);
        step_i = (b - a) * per_edge;
        step_j = (c - a) * per_edge;
        position = a + double(first.x) * step_i + double(first.y) * step_j;
    }
}

// One row of the projection of: the first sample, a step in i, a step in j.
dvec3 project_row(uint c, uint row) {
    uint k = 12u * c + 4u * row;
    dvec3 weights = dvec3(img_from_local[k], img_from_local[k + 1u], img_from_local[k + 2u]);
    return dvec3(dot(weights, position) + img_from_local[k + 3u], dot(weights, step_i),
                 dot(weights, step_j));
}

// Ask the rectangle around the block's samples, and choose the precision to sample in.
// `reach` is BLOCK - 1 steps, `rest` the steps from the block's first sample to the diagonal.
uint block_vote(uint c, int reach, int rest) {
    dvec3 row_x = project_row(c, 0u), row_y = project_row(c, 1u), row_z = project_row(c, 2u);
    Extent extent = NOWHERE;
    int near = min(reach, rest);
    for (int k = 0; k < 5; ++k) {
        // The five corners of a square cut by the diagonal; some coincide where it is not cut.
        ivec2 d = ivec2(0);
        if (k == 1) d = ivec2(near, 0);
        else if (k == 2) d = ivec2(0, near);
        else if (k == 3) d = ivec2(near, min(reach, rest - near));
        else if (k == 4) d = ivec2(min(reach, rest - near), near);
        vec3 weights = vec3(1.0, d);
        float depth_m = dot(vec3(row_z), weights);
        vec2 pixel = vec2(dot(vec3(row_x), weights), dot(vec3(row_y), weights)) / depth_m;
        widen(extent, pixel, depth_m);
    }
    vec3 pads = pads_of(c, reach_m);

    looks[c].is_single = false;
    if (extent.depth_min_m >= pads.z) {
        double per_depth = 1.0LF / row_z.x;
        dvec2 pixel = dvec2(row_x.x, row_y.x) * per_depth;
        vec2 along_i = vec2((dvec2(row_x.y, row_y.y) - pixel * row_z.y) * per_depth);
        vec2 along_j = vec2((dvec2(row_x.z, row_y.z) - pixel * row_z.z) * per_depth);
        vec2 depth_steps = vec2(row_z.yz * per_depth);
        float smallest = float(double(extent.depth_min_m) * per_depth);
        vec2 span_px = float(near) * (abs(along_i) + abs(along_j)) / smallest;
        float depths = 1.0 + float(near) * (abs(depth_steps.x) + abs(depth_steps.y));
        float error_px = 5.97e-8 * (max(span_px.x, span_px.y) * (12.0 + 6.0 * depths / smallest) + 3.0);
        // Far outside, the whole pixel would not fit an integer.
        if (error_px < MAX_ERROR_PX && all(lessThan(abs(pixel), dvec2(1e6LF)))) {
            dvec2 whole = floor(pixel);
            looks[c].whole_px = ivec2(whole);
            looks[c].fraction_px = vec2(pixel - whole);
            looks[c].along_i = along_i;
            looks[c].along_j = along_j;
            looks[c].depth_steps = depth_steps;
            looks[c].is_single = true;
        }
    }
    if (!looks[c].is_single) {
        for (uint k = 0u; k < 3u; ++k) {
            projected[9u * c + k] = row_x[k];
            projected[9u * c + 3u + k] = row_y[k];
            projected[9u * c + 6u + k] = row_z[k];
        }
    }
    return camera_vote(c, extent, pads);
}

dvec3 projected_row(uint c, uint row) {
    uint k = 9u * c + 3u * row;
    return dvec3(projected[k], projected[k + 1u], projected[k + 2u]);
}

bool is_set(uint first_word, uint bit) {
    return (masks[first_word + (bit >> 5)] >> (bit & 31u) & 1u) != 0u;
}

// Return ACCEPTS on an object pixel, REJECTS on a background pixel, ABSTAINS where not seen.
uint sample_vote(uint c, int di, int dj) {
    ivec2 size_px = ivec2(cameras[c].image.xy);
    ivec2 pixel;
    if (looks[c].is_single) {
        float denominator = 1.0 + (float(di) * looks[c].depth_steps.x
                                   + float(dj) * looks[c].depth_steps.y);
        vec2 offset = (float(di) * looks[c].along_i + float(dj) * looks[c].along_j) / denominator;
        pixel = looks[c].whole_px + ivec2(floor(looks[c].fraction_px + offset));
        if (any(lessThan(pixel, ivec2(0))) || any(greaterThanEqual(pixel, size_px))) return ABSTAINS;
    } else {
        dvec3 steps = dvec3(1.0LF, double(di), double(dj));
        double depth_m = dot(projected_row(c, 2u), steps);
        if (!(depth_m > 0.0LF)) return ABSTAINS;
        double x = dot(projected_row(c, 0u), steps) / depth_m;
        double y = dot(projected_row(c, 1u), steps) / depth_m;
        if (!(x >= 0.0LF && y >= 0.0LF && x < double(size_px.x) && y < double(size_px.y))) {
            return ABSTAINS;
        }
        pixel = ivec2(int(x), int(y));
    }
    uint bit = uint(pixel.y) * uint(size_px.x) + uint(pixel.x);
    if (is_set(cameras[c].image.z, bit)) return ACCEPTS;
#if GAPS
    if (recorded[c].z != 0u && !is_set(recorded[c].x, bit)) return ABSTAINS;
#endif
    return REJECTS;
}

bool is_inside(int di, int dj) {
    uint n_seen = n_accept;
    for (uint k = 0u; k < n_undecided; ++k) {
        uint vote = sample_vote(undecided[k], di, dj);
        if (vote == REJECTS || (vote == ABSTAINS && keep == 0u)) return false;
        if (vote == ACCEPTS) ++n_seen;
    }
    return n_seen >= min_cameras;
}

// The samples of one row of the block, `rest` steps of which are left of the diagonal, as bits.
uint whole_row(int rest) {
    return rest < 0 ? 0u : 0xffffffffu >> (31 - min(rest, 31));
}

void main() {
    uint lane = gl_LocalInvocationID.x;
    uint n_items = min(counters[8u * launch + 7u], item_capacity);
    for (uint item = gl_WorkGroupID.x; item < n_items; item += gl_NumWorkGroups.x) {
        uint triangle = items[item].x;
        int u = viewports[triangle];
        int block = int(BLOCK);
        ivec2 first = block * ivec2(items[item].y & 0xffffu, items[item].y >> 16);
        int rest = u - 1 - first.x - first.y;
        if (lane < n_cameras) place_block(triangle, u, first);
        if (lane == 0u) n_undecided = n_accept = n_abstain = n_withhold = n_reject = n_runs = 0u;
        for (uint row = lane; row < BLOCK; row += GROUP) rows[row] = 0u;
        barrier();
        for (uint c = lane; c < n_cameras; c += GROUP) {
            uint vote = block_vote(c, block - 1, rest);
            if (vote == REJECTS) atomicAdd(n_reject, 1u);
            else if (vote == ACCEPTS) atomicAdd(n_accept, 1u);
            else if (vote == ABSTAINS) atomicAdd(n_abstain, 1u);
            else {
                if (vote == WITHHOLDS) atomicAdd(n_withhold, 1u);
                undecided[atomicAdd(n_undecided, 1u)] = c;
            }
        }
        barrier();
        uint found = n_reject > 0u ? FREE : verdict(n_accept, n_abstain, n_withhold);
        if (found == FULL) {
            for (uint row = lane; row < BLOCK; row += GROUP) rows[row] = whole_row(rest - int(row));
        } else if (found == OPEN) {
            // A block that the diagonal halves holds n (n + 1) / 2 samples: row r and row n - r
            // fill one line of n together. Others are asked as squares, beyond the diagonal none.
            bool is_half = rest < block;
            int n = is_half ? rest + 1 : block;
            int count = is_half ? n * (n + 1) / 2 : n * n;
            for (int k = int(lane); k < count; k += int(GROUP)) {
                int dj = k / n, di = k - dj * n;
                if (is_half && di >= n - dj) {
                    di -= n - dj;
                    dj = n - dj;
                }
                if (di + dj <= rest && is_inside(di, dj)) atomicOr(rows[dj], 1u << di);
            }
        }
        barrier();
        for (uint row = lane; row < BLOCK; row += GROUP) {
            uint starts = rows[row] & ~(rows[row] << 1);
            if (starts != 0u) run_places[row] = atomicAdd(n_runs, uint(bitCount(starts)));
        }
        barrier();
        if (lane == 0u && n_runs > 0u) first_run = atomicAdd(counters[hit_counter], n_runs);
        barrier();
        for (uint row = lane; row < BLOCK; row += GROUP) {
            uint bits = rows[row];
            // Numbered row by row; j (j - 1) is even. See hull/query/viewport.py.
            uint j = uint(first.y) + row;
            uint row_start = j * uint(u) - j * (j - 1u) / 2u + uint(first.x);
            for (uint run = first_run + run_places[row]; bits != 0u; ++run) {
                uint start = uint(findLSB(bits));
                uint stop = uint(findLSB(~bits & (0xffffffffu << start)) & 63);  // 63: to the end
                stop = min(stop, 32u);
                if (run < hit_capacity) {
                    hits[run] = uvec4(triangle, row_start + start, stop - start, mesh);
                }
                bits &= stop == 32u ? 0u : 0xffffffffu << stop;
            }
        }
        barrier();
    }
}
