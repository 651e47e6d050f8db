#version 430 core

// # The hull as it looked
//
// Each pixel of the hull takes its colour from the cameras that see the place: that whose line of
// sight is nearest to the viewer's, mixed with others where they are nearly as good, so that no
// seam is seen. What the hull itself hides from a camera takes nothing from it.
//
// ## References
//
// * Lok, Naik, Whitton and Brooks, 2003, section 1.3: the lit appearance of the real object is
//   mapped onto its visual hull.
// * Buehler, Bosse, McMillan, Gortler and Cohen, Unstructured lumigraph rendering, SIGGRAPH 2001:
//   the angle between lines of sight weighs the cameras.
// * Williams, Casting curved shadows on curved surfaces, SIGGRAPH 1978: a map of depths tells what
//   a camera sees.
//
// ## Resources
//
// Those of hull.common.glsl, and
//
// | binding | name        | type           | unit, frame                                          |
// |---------|-------------|----------------|------------------------------------------------------|
// | unit 2  | hull_depth  | sampler2D      | metres along the view                                |
// | unit 3  | hull_normal | sampler2D      | local frame                                          |
// | unit 4  | images      | sampler2DArray | layer = camera, its region; w = how far from the     |
// |         |             |                | silhouette's border, 0 to 1                          |
// | unit 5  | depths      | sampler2DArray | layer = camera, its region; metres along its axis to |
// |         |             |                | the hull's first surface, NEVER for none             |
//
// | output | name | type | unit                                                                    |
// |--------|------|------|-------------------------------------------------------------------------|
// | 0      | skin | vec4 | sRGB; w = 1 where a camera sees the place, else 0                       |

// INSERT

layout(location = 0) out vec4 skin;

layout(binding = 2) uniform sampler2D hull_depth;
layout(binding = 3) uniform sampler2D hull_normal;
layout(binding = 4) uniform sampler2DArray images;
layout(binding = 5) uniform sampler2DArray depths;

uniform vec3 eye;            // as in novel.frag.glsl
uniform vec3 right, down, forward;
uniform bool parallel;
uniform vec2 size_px;
uniform int n_pictures;      // cameras that colours are taken from, the first ones
uniform float depths_per_px; // texels of a map of depths for one pixel of the image

const int MOST_CAMERAS = 64;      // the same in hull/view/skin.py
const float FAR = 1.0e38;
const float SLACK_PX = 6.0;       // a place is seen if it is not so many pixels' worth behind the map
const float SHARPNESS = 24.0;     // how strongly the angle between lines of sight weighs
const float GRAZING = 0.35;       // cosine below which a camera sees a surface too flatly
const float SEAM = 0.45;          // a camera less good than this share of the best gives nothing

// How surely a camera sees a place: 0 where something is before it, or right beside what is.
float seen(int c, vec3 h, vec2 pixel) {
    float focal_px = 0.5 * (length(cameras[c].x.xyz - pixel.x * cameras[c].z.xyz)
                          + length(cameras[c].y.xyz - pixel.y * cameras[c].z.xyz));
    float slack = SLACK_PX * h.z / focal_px;
    vec2 at = pixel * depths_per_px - 0.5;
    ivec2 last = textureSize(depths, 0).xy - 1;
    float nearest = NEVER;
    for (int k = 0; k < 5; ++k) {
        ivec2 off = ivec2(k == 1 ? 1 : k == 2 ? -1 : 0, k == 3 ? 1 : k == 4 ? -1 : 0);
        ivec2 there = clamp(ivec2(round(at)) + off, ivec2(0), last);
        nearest = min(nearest, texelFetch(depths, ivec3(there, c), 0).r);
    }
    return 1.0 - smoothstep(slack, 2.0 * slack, h.z - nearest);
}

void main() {
    skin = vec4(0.0);
    ivec2 here = ivec2(gl_FragCoord.xy);
    float depth = texelFetch(hull_depth, here, 0).r;
    if (depth > FAR) return;
    vec2 place = 2.0 * gl_FragCoord.xy / size_px - 1.0;
    vec3 across = place.x * right + place.y * down;
    vec3 ray = parallel ? forward : forward + across;
    vec3 point = (parallel ? eye + across : eye) + depth * ray;
    vec3 normal = texelFetch(hull_normal, here, 0).xyz;
    vec3 to_eye = -normalize(ray);

    float weights[MOST_CAMERAS];
    float best = 0.0;
    vec2 texel = 1.0 / vec2(textureSize(images, 0).xy);
    for (int c = 0; c < n_pictures; ++c) {
        weights[c] = 0.0;
        vec3 h = project(c, point);
        vec2 pixel = h.xy / h.z;
        vec4 window = cameras[c].window;
        if (h.z <= 0.0 || any(lessThan(pixel, window.xy)) || any(greaterThan(pixel, window.zw)))
            continue;
        // The camera stands where all its rows are 0; along its ray the depth is that of h.
        vec3 r0 = cross(cameras[c].y.xyz, cameras[c].z.xyz);
        vec3 r1 = cross(cameras[c].z.xyz, cameras[c].x.xyz);
        vec3 r2 = cross(cameras[c].x.xyz, cameras[c].y.xyz);
        vec3 along = pixel.x * r0 + pixel.y * r1 + r2;
        vec3 to_camera = normalize(-along * sign(dot(along, cameras[c].z.xyz)));
        float facing = smoothstep(0.0, GRAZING, dot(normal, to_camera));
        float beside = 0.5 + 0.5 * dot(to_eye, to_camera);
        float inner = texture(images, vec3(pixel * texel, float(c))).w;
        float weight = pow(max(beside, 1e-3), SHARPNESS) * (0.02 + 0.98 * facing)
                     * (0.005 + 0.995 * inner * inner);
        if (weight <= SEAM * best) continue;
        weights[c] = weight * seen(c, h, pixel);
        best = max(best, weights[c]);
    }
    if (best <= 0.0) return;
    vec4 sum = vec4(0.0);
    for (int c = 0; c < n_pictures; ++c) {
        float share = smoothstep(SEAM, 1.0, weights[c] / best);
        if (share <= 0.0) continue;
        vec3 h = project(c, point);
        vec3 colour = texture(images, vec3(h.xy / h.z * texel, float(c))).rgb;
        sum += share * vec4(colour * colour, 1.0);  // light adds up in linear values
    }
    skin = vec4(sqrt(sum.rgb / sum.w), 1.0);
}
