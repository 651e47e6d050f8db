// # The hull, as every program of the picture asks it
//
// Inserted into other shaders, after their #version line.
// NumPy twin: hull/query/reference.py, contains_points(); hull/view/novel.py, first_surface().
//
// ## Resources
//
// | binding | name      | type            | unit, frame                                          |
// |---------|-----------|-----------------|------------------------------------------------------|
// | 0       | cameras   | Camera[]        | rows of pixel-of-region from metres, local frame     |
// | unit 0  | distances | usampler2DArray | layer = camera; 0 on object pixels, else a distance  |
// |         |           |                 | to the nearest object pixel, rounded down, at most   |
// |         |           |                 | 255; with keeps, or to the border of the image;      |
// |         |           |                 | with has_gaps at most 127, or to a pixel that was    |
// |         |           |                 | not recorded, and there UNRECORDED plus the distance |
// |         |           |                 | to the nearest one that was                          |
// | unit 1  | soft      | sampler2DArray  | layer = camera; the silhouette blurred, 0 to 1       |
//
// A region is the part of a camera's image that its layer holds. Its window, in pixels of the
// region, is where a point can matter: the bounding box of the silhouette, or, with keeps, the
// image: outside of it, and on pixels that were not recorded, the camera abstains.

struct Camera {
    vec4 x, y, z;   // rows of the projection matrix
    vec4 window;    // left, top, right, bottom
};

layout(std430, binding = 0) readonly buffer Cameras { Camera cameras[]; };
layout(binding = 0) uniform usampler2DArray distances;
layout(binding = 1) uniform sampler2DArray soft;

uniform int n_cameras;     // 0: the hull is empty
uniform bool keeps;        // unseen = "keep"
uniform bool has_gaps;     // with keeps: some pixels were not recorded
uniform int min_cameras;   // with keeps: how many must see a point

const float NEVER = 3.0e38;
const uint UNRECORDED = 128u;   // the same in hull/view/novel.py

vec3 project(int c, vec3 point) {
    vec4 p = vec4(point, 1.0);
    return vec3(dot(cameras[c].x, p), dot(cameras[c].y, p), dot(cameras[c].z, p));
}

vec3 project_direction(int c, vec3 d) {
    return vec3(dot(cameras[c].x.xyz, d), dot(cameras[c].y.xyz, d), dot(cameras[c].z.xyz, d));
}

uint distance_at(int c, vec2 pixel) {
    vec4 window = cameras[c].window;
    ivec2 cell = clamp(ivec2(floor(pixel)), ivec2(window.xy), ivec2(window.zw) - 1);
    return texelFetch(distances, ivec3(cell, c), 0).r;
}

bool hull_contains(vec3 point) {
    int seen = 0;
    for (int c = 0; c < n_cameras; ++c) {
        vec3 h = project(c, point);
        vec2 pixel = h.xy / h.z;
        vec4 window = cameras[c].window;
        bool sees = h.z > 0.0 && all(greaterThanEqual(pixel, window.xy))
                              && all(lessThan(pixel, window.zw));
        if (!sees && !keeps) return false;
        if (sees) {
            uint away = distance_at(c, pixel);
            if (has_gaps && away >= UNRECORDED) continue;
            if (away != 0u) return false;
            ++seen;
        }
    }
    return n_cameras > 0 && (!keeps || seen >= min_cameras);
}
