// # What the rectangle around a projection proves, in one camera
//
// Inserted into the passes of the volume query, never compiled alone.
// NumPy reference: hull/query/bounds.py, verdicts(); the argument why rounding cannot turn the
// proof into a guess stands there. The pads are those of single precision, which also cover what
// is computed in double precision and rounded afterwards.
//
// ## Resources
//
// | binding | name      | type            | unit, frame                                          |
// |---------|-----------|-----------------|------------------------------------------------------|
// | block 0 | cameras   | Camera[n]       | see below                                            |
// | block 1 | pad_rows  | vec4[2 n]       | pixels times metres, per metre of reach: x, y        |
// | block 2 | order     | uvec4[n / 4]    | cameras, the one that rejects most first             |
// | block 3 | recorded  | uvec4[n]        | what a camera recorded: first word in masks, first   |
// |         |           |                 | number in integrals, then 1, or 0 if that is all     |
// | 0       | integrals | int[]           | object pixels above and left of a pixel corner; then |
// |         |           |                 | recorded pixels, of cameras that did not record all  |
//
// N_CAMERAS, at least n_cameras, is the room in the blocks: 256 cameras fill 16 KiB, which every
// device offers. REJECT is 0 where rectangles are to decide nothing, and GAPS is 1 where some camera
// did not record all of its image; block 3 is asked then only.
//
// The pads of a camera are linear in the reach of a set, its largest absolute coordinates (M in
// bounds.py). So each set has pads of its own, from its own corners, and a mesh that moves needs
// no look at all its vertices before. The two rows are exact to 1e-7; bounds.py has 2 u B_k to
// spare of its 32 u B_k.

struct Camera {
    vec4 img_from_local[3];   // rows of the projection: pixels from metres, local frame
    uvec4 image;              // width, height, first word in masks, first number in integrals
};

layout(std140, binding = 0) uniform Cameras { Camera cameras[N_CAMERAS]; };
layout(std140, binding = 1) uniform Pads { vec4 pad_rows[2 * N_CAMERAS]; };
layout(std140, binding = 2) uniform Order { uvec4 order[N_CAMERAS / 4]; };
#if GAPS
layout(std140, binding = 3) uniform Recorded { uvec4 recorded[N_CAMERAS]; };
#endif
layout(std430, binding = 0) readonly buffer Integrals { int integrals[]; };

uniform uint n_cameras;
uniform uint keep;         // 1: a camera that cannot see a point abstains; 0: it carves
uniform uint min_cameras;

// The same numbers as in hull/query/native.py.
const uint REJECTS = 0u;    // no sample is inside
const uint ACCEPTS = 1u;    // every sample is seen, on an object pixel
const uint ABSTAINS = 2u;   // no sample is seen
const uint UNDECIDED = 3u;
const uint WITHHOLDS = 4u;  // no sample is seen on an object pixel; some may be on background

// The same numbers as in hull/query/bounds.py.
const uint FREE = 0u;
const uint OPEN = 1u;
const uint FULL = 2u;

// Where the corners of a set fall in one camera.
struct Extent {
    vec2 low_px, high_px;
    float depth_min_m, depth_max_m;
};

const Extent NOWHERE = Extent(vec2(1e30), vec2(-1e30), 1e30, -1e30);

void widen(inout Extent extent, vec2 pixel, float depth_m) {
    extent.low_px = min(extent.low_px, pixel);
    extent.high_px = max(extent.high_px, pixel);
    extent.depth_min_m = min(extent.depth_min_m, depth_m);
    extent.depth_max_m = max(extent.depth_max_m, depth_m);
}

void widen_by_point(inout Extent extent, uint c, vec3 point_local) {
    vec4 h = vec4(point_local, 1.0);
    float depth_m = dot(cameras[c].img_from_local[2], h);
    vec2 pixel = vec2(dot(cameras[c].img_from_local[0], h), dot(cameras[c].img_from_local[1], h));
    widen(extent, pixel / depth_m, depth_m);
}

// By how much rectangles grow in x and y, pixels times metres, and from which depth this holds.
// `reach_m` holds the largest absolute coordinates of the set, and 1.
vec3 pads_of(uint c, vec4 reach_m) {
    vec2 pad = vec2(dot(pad_rows[2u * c], reach_m), dot(pad_rows[2u * c + 1u], reach_m));
    float far_px = 2.0 * float(max(cameras[c].image.x, cameras[c].image.y));
    return vec3(pad, max(8.0 * max(pad.x, pad.y) / far_px, 1e-30));
}

// How many pixels of a rectangle an integral image counts, which begins at a number of integrals.
int count_pixels(uint first, uint stride, ivec2 start, ivec2 stop) {
    return integrals[first + uint(stop.y) * stride + uint(stop.x)]
         - integrals[first + uint(start.y) * stride + uint(stop.x)]
         - integrals[first + uint(stop.y) * stride + uint(start.x)]
         + integrals[first + uint(start.y) * stride + uint(start.x)];
}

uint camera_vote(uint c, Extent extent, vec3 pads) {
    if (REJECT == 0) return UNDECIDED;
    vec2 size_px = vec2(cameras[c].image.xy);
    // One pixel beyond the image says as much as any farther out.
    vec2 first = vec2(-1.0), last = size_px;
    if (extent.depth_min_m >= pads.z) {
        vec2 pad_px = pads.xy / extent.depth_min_m;
        first = floor(clamp(extent.low_px - pad_px, vec2(-1.0), size_px));
        last = floor(clamp(extent.high_px + pad_px, vec2(-1.0), size_px));
    } else if (extent.depth_max_m <= -pads.z) {
        last = vec2(-1.0);
    }
    ivec2 start = max(ivec2(first), ivec2(0));
    ivec2 stop = min(ivec2(last) + 1, ivec2(size_px));
    if (any(lessThanEqual(stop, start))) return keep != 0u ? ABSTAINS : REJECTS;

    bool wholly_seen = all(greaterThanEqual(first, vec2(0.0))) && all(lessThan(last, size_px));
    uint stride = cameras[c].image.x + 1u;
    ivec2 extent_px = stop - start;
    int area = extent_px.x * extent_px.y;
#if GAPS
    if (recorded[c].z != 0u) {
        int n_seen = count_pixels(recorded[c].y, stride, start, stop);
        if (n_seen == 0) return ABSTAINS;
        wholly_seen = wholly_seen && n_seen == area;
    }
#endif
    int count = count_pixels(cameras[c].image.w, stride, start, stop);
    if (count == 0) return wholly_seen || keep == 0u ? REJECTS : WITHHOLDS;
    if (wholly_seen && count == area) return ACCEPTS;
    return UNDECIDED;
}

// What the votes of all cameras prove, none of which rejects.
uint verdict(uint n_accept, uint n_abstain, uint n_withhold) {
    if (n_cameras - n_abstain - n_withhold < min_cameras) return FREE;
    return n_accept + n_abstain == n_cameras ? FULL : OPEN;
}
