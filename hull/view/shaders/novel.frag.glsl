#version 430 core

// # The hull from a novel viewpoint
//
// One invocation per pixel: where does its ray first enter the hull, and how does the surface lie
// there? NumPy twin: hull/view/novel.py, first_surface().
//
// ## References
//
// * Lok, Naik, Whitton and Brooks, 2003, section 3.2: the view frustum is queried against the
//   hull, which gives its correctly z-buffered first-visible surface. The paper queries planes
//   from near to far; here every ray walks at its own pace.
// * Matusik, Buehler, Raskar, Gortler and McMillan, Image-based visual hulls, SIGGRAPH 2000: rays
//   are followed in the images of the cameras.
// * Hart, Sphere tracing, The Visual Computer 12, 1996: a distance is a safe step.
//
// ## Method
//
// A ray is a straight line in the image of every camera. Where a camera sees background, the ray
// leaves it only after as many pixels as the nearest object pixel is away; the ray moves
//
//     s K / (w (w + w' s))   pixels   in s,   K = |h' w - h w'| the same all along the ray,
//
// which is solved for s: a step in which nothing can be missed. Near the silhouette it goes from
// pixel to pixel. One camera is asked at a time, until all agree at the same place:
//
//      o---------->------->---->-->->|  camera 0: outside ... object pixel
//                                    |---->-->->|  camera 1
//                                               x  all agree: the surface
//
// ## Resources
//
// Those of hull.common.glsl, and
//
// | output | name   | type | unit, frame                                                        |
// |--------|--------|------|--------------------------------------------------------------------|
// | 0      | depth  | R32F | metres along `forward`; NEVER where the ray misses                 |
// | 1      | normal | vec4 | outward, local frame; w = 1 where the ray hits                     |
//
// ## Numerics
//
// float32. The surface is found to OVERSHOOT_PX, in the image of the camera that bounds the hull
// there. The normal comes from the blurred silhouette, so that a staircase of pixels shades like
// the edge it stands for.

// INSERT

layout(location = 0) out float depth;
layout(location = 1) out vec4 normal;

uniform vec3 eye;            // metres, local frame; a ray is eye + t forward, t = depth
uniform vec3 right, down;    // from the middle of the picture to its border: per metre of depth,
uniform vec3 forward;        //   or, parallel, in metres
uniform bool parallel;
uniform vec2 size_px;
uniform vec2 range_m;        // nearest and farthest depth
uniform vec3 box_low, box_high;  // contains the hull, metres, local frame

const int MAX_STEPS = 4096;
const float OVERSHOOT_PX = 2e-3;  // the same in hull/view/novel.py
const float SAFE_PX = 1.5;        // two points of two pixels are sqrt(2) nearer than their centres

// Where a + b t >= 0, intersected with range.
vec2 narrowed(vec2 range, float a, float b) {
    if (b > 0.0) range.x = max(range.x, -a / b);
    else if (b < 0.0) range.y = min(range.y, -a / b);
    else if (a < 0.0) range = vec2(NEVER, -NEVER);
    return range;
}

vec2 window_range(vec3 h, vec3 slope, vec4 window) {
    vec2 range = narrowed(vec2(-NEVER, NEVER), h.z, slope.z);
    range = narrowed(range, h.x - window.x * h.z, slope.x - window.x * slope.z);
    range = narrowed(range, window.z * h.z - h.x, window.z * slope.z - slope.x);
    range = narrowed(range, h.y - window.y * h.z, slope.y - window.y * slope.z);
    return narrowed(range, window.w * h.z - h.y, window.w * slope.z - slope.y);
}

// How far t may grow while the ray's pixel moves by this many pixels.
float step_of(float pixels, float speed, float w, float w_slope) {
    float rest = speed - pixels * w * w_slope;
    return rest > 0.0 ? pixels * w * w / rest : NEVER;
}

// How far t may grow from a place of the ray, h, in a camera's image until it can come to a pixel
// that is `away` from the one it is on.
float step_to(uint away, vec3 start, vec3 slope, vec3 h) {
    vec2 pixel = h.xy / h.z;
    vec2 course = slope.xy * start.z - start.xy * slope.z;
    float speed = length(course);
    float pixels = float(away) - SAFE_PX;
    if (away < 3u) {  // to the border of this pixel
        vec2 unit = course / max(speed, 1e-30);
        vec2 inner = pixel - floor(pixel);
        vec2 border = mix(inner, 1.0 - inner, greaterThan(unit, vec2(0.0)));
        border /= max(abs(unit), vec2(1e-9));
        pixels = min(border.x, border.y) + OVERSHOOT_PX;
    }
    return step_of(pixels, speed, h.z, slope.z);
}

bool first_surface(vec3 origin, vec3 direction, vec2 range, out float t, out int bounding) {
    bounding = -1;
    t = range.x;
    float end = range.y;
    if (!keeps) {
        for (int c = 0; c < n_cameras; ++c) {
            vec2 seen = window_range(project(c, origin), project_direction(c, direction),
                                     cameras[c].window);
            if (seen.x > t) { t = seen.x; bounding = c; }
            end = min(end, seen.y);
            if (t >= end) return false;
        }
    }
    int c = 0, agreed = 0, n_seen = 0;
    float next_seen = NEVER;
    for (int i = 0; i < MAX_STEPS; ++i) {
        vec3 start = project(c, origin), slope = project_direction(c, direction);
        vec3 h = start + t * slope;
        bool sees = true;
        if (keeps) {
            vec2 seen = window_range(start, slope, cameras[c].window);
            sees = t >= seen.x && t < seen.y;
            if (t < seen.x && seen.x < seen.y) next_seen = min(next_seen, seen.x);
        }
        uint away = 0u;
        if (sees) away = distance_at(c, h.xy / h.z);
        float least = 5e-7 * max(t, 0.1);
        if (has_gaps && away >= UNRECORDED) {  // it abstains, at least so far
            sees = false;
            next_seen = min(next_seen, t + max(step_to(away - UNRECORDED, start, slope, h), least));
            away = 0u;
        }
        if (away == 0u) {
            ++agreed;
            if (sees) ++n_seen;
            c = c + 1 < n_cameras ? c + 1 : 0;
            if (agreed < n_cameras) continue;
            if (!keeps || n_seen >= min_cameras) return true;
            if (next_seen >= end) return false;
            t = max(next_seen, t + 1e-6 * max(t, 1.0));  // no camera speaks sooner
        } else {
            t += max(step_to(away, start, slope, h), least);
            bounding = c;
            if (t >= end) return false;
        }
        agreed = 0;
        n_seen = 0;
        next_seen = NEVER;
    }
    return false;
}

// The silhouette's edge and the camera's centre span a plane that touches the hull.
vec3 surface_normal(vec3 point, int c, vec3 direction) {
    vec3 towards_eye = -normalize(direction);
    if (c < 0) return towards_eye;
    vec3 h = project(c, point);
    vec2 pixel = h.xy / h.z;
    vec2 texel = 1.0 / vec2(textureSize(soft, 0).xy);
    vec3 at = vec3(pixel * texel, float(c));
    const float reach = 1.5;
    vec2 inward = vec2(
        texture(soft, at + vec3(reach * texel.x, 0.0, 0.0)).r
            - texture(soft, at - vec3(reach * texel.x, 0.0, 0.0)).r,
        texture(soft, at + vec3(0.0, reach * texel.y, 0.0)).r
            - texture(soft, at - vec3(0.0, reach * texel.y, 0.0)).r);
    vec3 n = -(inward.x * (cameras[c].x.xyz - pixel.x * cameras[c].z.xyz)
             + inward.y * (cameras[c].y.xyz - pixel.y * cameras[c].z.xyz));
    float size = length(n);
    if (length(inward) < 0.004 || size == 0.0) return towards_eye;  // one step of 8 bits
    n /= size;
    float turned_away = min(dot(n, towards_eye), 0.0);  // blurring can turn a grazing surface away
    return normalize(n - turned_away * towards_eye);
}

void main() {
    vec2 place = 2.0 * gl_FragCoord.xy / size_px - 1.0;
    vec3 across = place.x * right + place.y * down;
    vec3 origin = parallel ? eye + across : eye;
    vec3 direction = parallel ? forward : forward + across;

    depth = NEVER;
    normal = vec4(0.0);
    vec2 range = range_m;
    for (int axis = 0; axis < 3; ++axis) {
        range = narrowed(range, origin[axis] - box_low[axis], direction[axis]);
        range = narrowed(range, box_high[axis] - origin[axis], -direction[axis]);
    }
    if (n_cameras == 0 || range.x >= range.y) return;
    float t;
    int bounding;
    if (first_surface(origin, direction, range, t, bounding)) {
        depth = t;
        normal = vec4(surface_normal(origin + t * direction, bounding, direction), 1.0);
    }
}
