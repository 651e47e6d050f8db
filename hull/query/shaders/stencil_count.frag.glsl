#version 430 core

// # Volume query as published, fragment stage: one camera's projected texture
//
// One fragment per sample and pass. What the camera's texel adds to the pixel's counter is
// blended in, one plus one: nothing on background, nor outside the image, where the border of the
// texture lies, nor on a pixel that was not recorded. (To discard such fragments costs a software renderer 6 % more than to add 0.)
// The sample is known by the pixel's index in its cell, not by interpolation.
// NumPy reference: hull/query/reference.py, contains_points().
//
// ## Resources
//
// | binding | name       | type      | unit, frame                                                |
// |---------|------------|-----------|------------------------------------------------------------|
// | unit 0  | increments | sampler2D | 1/255 on an object pixel; 0, or 1 with unseen = "keep", on |
// |         |            |           | background, and 0 on pixels that were not recorded; a      |
// |         |            |           | border of one texel that is 0                              |
//
// ## Numerics
//
// See stencil_cell.vert.glsl. Pixels are the floor of the projection.

// INSERT

layout(binding = 0) uniform sampler2D increments;
layout(location = 0) out float counted;

flat in vec2 origin_px;

#if PRECISE
flat in dvec3 row_x, row_y, row_depth;

ivec2 texel() {
    dvec3 steps = dvec3(1.0LF, dvec2(gl_FragCoord.xy - origin_px));
    double depth_m = dot(row_depth, steps);
    if (!(depth_m > 0.0LF)) return ivec2(0);
    dvec2 place = dvec2(dot(row_x, steps), dot(row_y, steps)) / depth_m;
    dvec2 size_px = dvec2(textureSize(increments, 0) - 2);
    bool is_seen = place.x >= 0.0LF && place.y >= 0.0LF && place.x < size_px.x
                   && place.y < size_px.y;
    return is_seen ? ivec2(place) + 1 : ivec2(0);
}
#else
flat in vec4 pixel, along;
flat in vec2 depths;

ivec2 texel() {
    vec2 steps = gl_FragCoord.xy - origin_px;
    float per_depth = 1.0 / (1.0 + (steps.x * depths.x + steps.y * depths.y));
    vec2 offset_px = (steps.x * along.xy + steps.y * along.zw) * per_depth;
    vec2 place = floor(pixel.xy + offset_px) + pixel.zw;
    return clamp(ivec2(place) + 1, ivec2(0), textureSize(increments, 0) - 1);
}
#endif

void main() {
    counted = texelFetch(increments, texel(), 0).r;
}
