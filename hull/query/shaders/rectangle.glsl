// # What the rectangle around a projection proves, in one camera
//
// Inserted into volume_reject.comp.glsl and volume_sample.comp.glsl, never compiled alone.
// NumPy reference: hull/query/bounds.py, verdicts(); the argument why rounding cannot turn the
// proof into a guess stands there. The pads are those of single precision, which also cover what
// is computed in double precision and rounded afterwards.
//
// ## Resources
//
// | binding | name      | type            | unit, frame                                          |
// |---------|-----------|-----------------|------------------------------------------------------|
// | block 0 | cameras   | Camera[n]       | see below                                            |
// | block 1 | pads      | vec4[n]         | pixels times metres in x, in y; metres; unused       |
// | block 2 | order     | uvec4[n / 4]    | cameras, the one that rejects most first             |
// | 0       | integrals | int[]           | object pixels above and left of a pixel corner       |
//
// N_CAMERAS, at least n_cameras, is the room in the blocks: 256 cameras fill 16 KiB, which every
// device offers.

struct Camera {
    vec4 img_from_local[3];   // rows of the projection: pixels from metres, local frame
    uvec4 image;              // width, height, first word in masks, first number in integrals
};

layout(std140, binding = 0) uniform Cameras { Camera cameras[N_CAMERAS]; };
layout(std140, binding = 1) uniform Pads { vec4 pads[N_CAMERAS]; };
layout(std140, binding = 2) uniform Order { uvec4 order[N_CAMERAS / 4]; };
layout(std430, binding = 0) readonly buffer Integrals { int integrals[]; };

uniform uint n_cameras;
uniform uint keep;         // 1: a camera that cannot see a point abstains; 0: it carves
uniform uint min_cameras;

// The same numbers as in hull/query/native.py.
const uint REJECTS = 0u;    // no sample is inside
const uint ACCEPTS = 1u;    // every sample is seen, on an object pixel
const uint ABSTAINS = 2u;   // no sample is seen
const uint UNDECIDED = 3u;

uint camera_vote(uint c, vec2 low, vec2 high, float depth_min_m, float depth_max_m) {
    vec2 size_px = vec2(cameras[c].image.xy);
    // One pixel beyond the image says as much as any farther out.
    vec2 first = vec2(-1.0), last = size_px;
    if (depth_min_m >= pads[c].z) {
        vec2 pad_px = pads[c].xy / depth_min_m;
        first = floor(clamp(low - pad_px, vec2(-1.0), size_px));
        last = floor(clamp(high + pad_px, vec2(-1.0), size_px));
    } else if (depth_max_m <= -pads[c].z) {
        last = vec2(-1.0);
    }
    ivec2 start = max(ivec2(first), ivec2(0));
    ivec2 stop = min(ivec2(last) + 1, ivec2(size_px));
    if (any(lessThanEqual(stop, start))) return keep != 0u ? ABSTAINS : REJECTS;

    bool wholly_seen = all(greaterThanEqual(first, vec2(0.0))) && all(lessThan(last, size_px));
    uint stride = cameras[c].image.x + 1u;
    uint base = cameras[c].image.w;
    int count = integrals[base + uint(stop.y) * stride + uint(stop.x)]
              - integrals[base + uint(start.y) * stride + uint(stop.x)]
              - integrals[base + uint(stop.y) * stride + uint(start.x)]
              + integrals[base + uint(start.y) * stride + uint(start.x)];
    if (count == 0 && (wholly_seen || keep == 0u)) return REJECTS;
    ivec2 extent = stop - start;
    if (wholly_seen && count == extent.x * extent.y) return ACCEPTS;
    return UNDECIDED;
}
