#version 430 core

// # Volume query as published, geometry stage: the triangle that fills half its viewport
//
// Draws the triangle of a cell so that exactly the pixels (i, j), i + j <= u - 1, of its cell are
// rasterised, the cell's left lower pixel being (0, 0). The vertices of the triangle lie on the
// centres of the pixels (0, 0), (u - 1, 0) and (0, u - 1), but rasterisers drop samples that lie
// exactly on an edge: it is drawn slightly outset,
//
//     (0, u + 1/2)
//       | .             pixel centres on the diagonal:          i + j + 1 = u
//       |   .           the outset edge:                        x + y     = u + 1/2
//       |     .         the next pixel centres, not drawn:      i + j + 1 = u + 1
//     (0, 0) --- (u + 1/2, 0)
//
// which keeps every pixel centre at least a third of a pixel away from all edges; the fixed point
// that hardware rasterises in rounds to 1/256.

// INSERT

layout(points) in;
layout(triangle_strip, max_vertices = 3) out;

in vec2 cell_origin_px[];
in int cell_rest[];
flat out vec2 origin_px;   // centre of the cell's pixel (0, 0) in the window
#if PRECISE
in dvec3 cell_x[], cell_y[], cell_depth[];
flat out dvec3 row_x, row_y, row_depth;
#else
in vec4 cell_pixel[], cell_along[];
in vec2 cell_depths[];
flat out vec4 pixel, along;
flat out vec2 depths;
#endif

void corner(vec2 offset_px) {
    origin_px = cell_origin_px[0] + 0.5;
#if PRECISE
    row_x = cell_x[0];
    row_y = cell_y[0];
    row_depth = cell_depth[0];
#else
    pixel = cell_pixel[0];
    along = cell_along[0];
    depths = cell_depths[0];
#endif
    gl_Position = vec4((cell_origin_px[0] + offset_px) * (2.0 / float(WINDOW)) - 1.0, 0.0, 1.0);
    EmitVertex();
}

void main() {
    if (cell_rest[0] < 0) return;
    // A tile that the diagonal does not cut is a square: this much of the triangle covers it.
    float leg_px = float(min(cell_rest[0], 2 * WINDOW)) + 1.5;
    corner(vec2(0.0));
    corner(vec2(leg_px, 0.0));
    corner(vec2(0.0, leg_px));
    EndPrimitive();
}
