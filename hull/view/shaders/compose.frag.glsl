#version 430 core

// # The picture: hull, objects, floor, and what collides shining through
//
// What is inside the hull is always behind the hull's surface. So the hull is drawn opaque, as a
// body, and what collides is laid over it as if it shone through; CAD inside or behind the hull is
// seen faintly.
//
// ## Resources
//
// | binding | name        | type      | unit, frame                                              |
// |---------|-------------|-----------|----------------------------------------------------------|
// | unit 2  | hull_depth  | sampler2D | metres along the view; NEVER for nothing                 |
// | unit 3  | hull_normal | sampler2D | local frame                                              |
// | unit 4  | mesh_depth  | sampler2D | nearest object                                           |
// | unit 5  | mesh_normal | sampler2D | local frame; w = kind (mesh.frag.glsl)                   |
// | unit 6  | hit_depth   | sampler2D | nearest part of an object inside the hull                |
// | unit 7  | hit_normal  | sampler2D | local frame                                              |
// | unit 8  | shade_map   | sampler2D | darkness of the floor, 0 to 1, over floor_low..floor_high |
// | unit 9  | skin_map    | sampler2D | with has_skin the hull's colour; w = 0 where nobody saw   |
// |         |             |           | it                                                        |
// | unit 10 | backdrop    | sampler2D | with has_backdrop what the camera recorded, all over the  |
// |         |             |           | picture                                                   |
//
// Colours are sRGB in and out; light adds up in linear values.

layout(location = 0) out vec4 colour;

layout(binding = 2) uniform sampler2D hull_depth;
layout(binding = 3) uniform sampler2D hull_normal;
layout(binding = 4) uniform sampler2D mesh_depth;
layout(binding = 5) uniform sampler2D mesh_normal;
layout(binding = 6) uniform sampler2D hit_depth;
layout(binding = 7) uniform sampler2D hit_normal;
layout(binding = 8) uniform sampler2D shade_map;
layout(binding = 9) uniform sampler2D skin_map;
layout(binding = 10) uniform sampler2D backdrop;

uniform vec3 eye;            // as in novel.frag.glsl
uniform vec3 right, down, forward;
uniform vec2 size_px;
uniform float edge_px;       // how far apart neighbours are looked at
uniform float occlusion_m;   // reach of the soft shadow in corners

uniform vec3 up, floor_x, floor_y;   // unit vectors: up, and two along the floor
uniform vec3 floor_point;            // a point of the floor where the grid's lines cross
uniform float grid_m;
uniform vec2 floor_low, floor_high;  // where shade_map lies, along floor_x and floor_y
uniform vec2 floor_middle;           // the floor fades away from here
uniform float floor_reach_m;
uniform bool has_floor;

uniform vec3 hull_colour, free_colour, colliding_colour, touched_colour, inside_colour;

uniform bool has_skin;       // the hull is drawn as it looked, and nothing shines through but hits
uniform bool has_backdrop;   // the scene lies over a recorded picture, the hull as it is in it
uniform vec3 heat_colours[6];  // from far to near

const float HEATED = 5.0;    // the same in mesh.frag.glsl

const float NEVER = 3.0e38;
const float FAR = 1.0e38;
const float SHARP_EDGE = 0.86;  // cosine between the normals on either side of a drawn edge
const int OCCLUSION_TAPS = 8;
const vec3 OUTLINE = vec3(0.10, 0.95, 0.75);  // of the hull in a recorded picture
const float DARK = 0.55;        // of a colour where no lamp of the scene reaches

// A square stands for sRGB's curve: near enough for a drawing, and quick in software.
vec3 linear(vec3 srgb) { return srgb * srgb; }
vec3 encoded(vec3 light) { return sqrt(clamp(light, 0.0, 1.0)); }

vec3 ray_through(vec2 pixel) {
    vec2 place = 2.0 * pixel / size_px - 1.0;
    return forward + place.x * right + place.y * down;
}

vec3 lit(vec3 base, vec3 n, float open) {
    vec3 key = normalize(-0.55 * normalize(forward) - 0.5 * normalize(right) + 0.8 * up);
    vec3 fill = normalize(-0.7 * normalize(forward) + 0.9 * normalize(right) + 0.1 * up);
    float ambient = 0.34 + 0.16 * dot(n, up);
    float light = ambient * open + 0.62 * max(dot(n, key), 0.0) * mix(1.0, open, 0.4)
                + 0.16 * max(dot(n, fill), 0.0);
    return linear(base) * 0.86 * light;
}

vec3 base_of(float kind) {
    if (kind >= HEATED) {
        float at = 5.0 * (kind - HEATED);
        int below = int(min(floor(at), 4.0));
        return mix(heat_colours[below], heat_colours[below + 1], at - float(below));
    }
    if (kind > 3.5) return inside_colour;
    float bright = mix(1.0, DARK, clamp(fract(kind) / 0.4, 0.0, 1.0));
    if (kind > 2.5) return bright * touched_colour;
    if (kind > 1.5) return bright * colliding_colour;
    return bright * free_colour;
}

// How strongly a line is drawn here because the surface breaks off or bends sharply.
float edge(sampler2D depths, sampler2D normals, ivec2 here, float own_depth) {
    ivec2 last = ivec2(size_px) - 1;
    vec3 own = texelFetch(normals, here, 0).xyz;
    float strength = 0.0;
    for (int k = 0; k < 2; ++k) {
        ivec2 off = k == 0 ? ivec2(int(edge_px), 0) : ivec2(0, int(edge_px));
        ivec2 a = clamp(here - off, ivec2(0), last), b = clamp(here + off, ivec2(0), last);
        float za = texelFetch(depths, a, 0).r, zb = texelFetch(depths, b, 0).r;
        if (za > FAR || zb > FAR) { strength = 1.0; continue; }
        if (abs(za + zb - 2.0 * own_depth) > 0.006 * own_depth) strength = 1.0;
        vec3 na = texelFetch(normals, a, 0).xyz, nb = texelFetch(normals, b, 0).xyz;
        if (min(dot(own, na), dot(own, nb)) < SHARP_EDGE) strength = max(strength, 0.7);
    }
    return strength;
}

// Whether the hull ends beside this pixel.
float step_off(ivec2 here) {
    ivec2 last = ivec2(size_px) - 1;
    int reach = int(edge_px);
    float ends = 0.0;
    for (int k = 0; k < 4; ++k) {
        ivec2 off = reach * ivec2(k == 0 ? 1 : k == 1 ? -1 : 0, k == 2 ? 1 : k == 3 ? -1 : 0);
        ivec2 there = here + off;
        if (any(lessThan(there, ivec2(0))) || any(greaterThan(there, last))) continue;
        if (texelFetch(hull_depth, there, 0).r > FAR) ends = 1.0;
    }
    return ends;
}

// The share of the surroundings that is open, from what rises above the surface around.
float openness(ivec2 here, vec3 ray, float depth, vec3 n) {
    float reach_px = 0.5 * size_px.y * occlusion_m / (length(down) * depth);
    reach_px = min(reach_px, 0.12 * size_px.y);
    // A turn of its own for each pixel makes noise of bands; supersampling averages it.
    float turn = fract(52.9829189 * fract(dot(gl_FragCoord.xy, vec2(0.06711056, 0.00583715))));
    ivec2 last = ivec2(size_px) - 1;
    float hidden = 0.0;
    for (int k = 0; k < OCCLUSION_TAPS; ++k) {
        float r = sqrt((float(k) + 0.5) / float(OCCLUSION_TAPS));
        float angle = 2.399963 * float(k) + 6.2831853 * turn;
        ivec2 there = here + ivec2(reach_px * r * vec2(cos(angle), sin(angle)));
        there = clamp(there, ivec2(0), last);
        float other = min(texelFetch(hull_depth, there, 0).r, texelFetch(mesh_depth, there, 0).r);
        if (other > FAR) continue;
        vec3 towards = other * ray_through(vec2(there) + 0.5) - depth * ray;
        float away = length(towards);
        float rise = dot(towards, n) / max(away, 1e-9);
        hidden += smoothstep(0.15, 0.9, rise) * (1.0 - smoothstep(1.0, 2.5, away / occlusion_m));
    }
    return 1.0 - 0.9 * hidden / float(OCCLUSION_TAPS);
}

float grid_line(float at, float width) {
    float away = abs(fract(at - 0.5) - 0.5);
    float line = 1.0 - smoothstep(width * 0.6, width * 1.4, away);
    return line * (1.0 - smoothstep(0.1, 0.4, width));
}

void main() {
    ivec2 here = ivec2(gl_FragCoord.xy);
    vec3 direction = ray_through(gl_FragCoord.xy);

    float hull_z = texelFetch(hull_depth, here, 0).r;
    float mesh_z = texelFetch(mesh_depth, here, 0).r;
    float hit_z = texelFetch(hit_depth, here, 0).r;
    float scene_z = min(hull_z, mesh_z);

    vec3 light = mix(linear(vec3(0.985)), linear(vec3(0.905, 0.915, 0.93)), gl_FragCoord.y / size_px.y);
    if (has_backdrop) light = linear(texelFetch(backdrop, here, 0).rgb);
    vec3 behind = light;
    vec4 floor_light = vec4(0.0);
    float floor_z = NEVER;
    float slope = dot(direction, up);
    vec3 at_floor = vec3(0.0);
    // Derivatives are taken of every pixel, also where the floor is behind the eye.
    float to_floor = dot(floor_point - eye, up) / (abs(slope) > 1e-6 ? slope : -1e-6);
    at_floor = eye + to_floor * direction - floor_point;
    vec2 at = vec2(dot(at_floor, floor_x), dot(at_floor, floor_y));
    vec2 cells = at / grid_m;
    vec2 width = max(fwidth(cells), vec2(1e-6));
    if (has_floor && slope < -1e-6 && to_floor > 0.0) {
        floor_z = to_floor;
        float fade = exp(-pow(length(at - floor_middle) / floor_reach_m, 4.0));
        float line = max(grid_line(cells.x, width.x), grid_line(cells.y, width.y));
        vec2 map = (at - floor_low) / (floor_high - floor_low);
        bool mapped = all(greaterThan(map, vec2(0.0))) && all(lessThan(map, vec2(1.0)));
        float shade = mapped ? texture(shade_map, map).r : 0.0;
        vec3 ground = linear(vec3(0.945, 0.945, 0.94));
        ground = mix(ground, linear(vec3(0.70, 0.72, 0.75)), 0.75 * line);
        ground *= 1.0 - 0.55 * shade;
        floor_light = vec4(ground, fade);
    }

    if (scene_z > FAR) {
        light = mix(light, floor_light.rgb, floor_light.a);
    } else {
        vec3 front = hull_z < mesh_z ? texelFetch(hull_normal, here, 0).xyz
                                     : texelFetch(mesh_normal, here, 0).xyz;
        float open = openness(here, direction, scene_z, front);
        vec3 body = vec3(0.0);
        float kind = 0.0;
        if (mesh_z < FAR) {
            vec4 n = texelFetch(mesh_normal, here, 0);
            kind = n.w;
            body = lit(base_of(kind), n.xyz, mesh_z <= hull_z ? open : 1.0);
            body *= 1.0 - 0.6 * edge(mesh_depth, mesh_normal, here, mesh_z);
        }
        if (hull_z < mesh_z) {
            vec3 skin = lit(hull_colour, front, open);
            float through = kind > 1.5 && kind < HEATED ? 0.30 : 0.12;
            if (has_skin) {
                vec4 seen = texelFetch(skin_map, here, 0);
                skin = mix(skin, linear(seen.rgb), seen.w);
                through *= 0.4;
            }
            if (has_backdrop) {
                skin = mix(behind, linear(OUTLINE), 0.8 * step_off(here));
                through *= 0.4;
            }
            if (mesh_z < FAR) skin = mix(skin, body, through);
            light = skin;
        } else {
            light = has_backdrop ? mix(behind, body, 0.75) : body;
        }
        if (hit_z < FAR) {
            vec3 red = lit(inside_colour, texelFetch(hit_normal, here, 0).xyz, 1.0);
            // Laid over the hull it must be seen; behind CAD it must not pretend to be before it.
            bool behind_cad = mesh_z < hit_z * (1.0 - 1e-3) && mesh_z < hull_z;
            light = mix(light, red, behind_cad ? 0.4 : has_skin || has_backdrop ? 0.6 : 0.85);
            light *= 1.0 - 0.35 * edge(hit_depth, hit_normal, here, hit_z);
        }
        if (floor_z < scene_z * (1.0 - 1e-3)) light = mix(light, floor_light.rgb, 0.5 * floor_light.a);
    }
    colour = vec4(encoded(light), 1.0);
}
