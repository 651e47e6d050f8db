#version 430 core

// # Volume query as published, vertex stage: a triangle under one camera's projected texture
//
// One vertex per cell and pass. A cell is the u x u viewport of one triangle in the shared window;
// where the triangle wants a viewport larger than the window, one window-sized tile of it. This is
// the geometry transformation of the paper, n times m of them: the triangle is placed in its cell,
// seen along its normal, and the camera's projection of the cell's first sample and of the steps
// to its neighbours is composed. stencil_cell.geom.glsl draws the triangle.
// NumPy reference: hull/query/reference.py, contains_points().
//
// ## References
//
// * Lok, Naik, Whitton and Brooks, Incorporating Dynamic Real Objects into Immersive Virtual
//   Environments, 2003, sections 3.2, 4.2.4 and 4.4.2.
//
// ## Resources
//
// | name           | type       | unit, frame                                                    |
// |----------------|------------|----------------------------------------------------------------|
// | corner_a, b, c | dvec3      | metres about the views' local origin                           |
// | cell           | uvec4      | row << 16 + column in the window, first i, first j, viewport u |
// | img_from_local | dvec4[3]   | rows of this pass's projection: pixels from metres             |
// | first_row      | uint       | where in the window the cells' row 0 lies                      |
//
// ## Numerics
//
// A pixel computed plainly in float32 would be off by some 1e-3 px at 1600 px. Instead the cell's
// first sample and the steps are projected in float64, here, and the fragments add in float32:
//
//     pixel(di, dj) = p + (di A + dj B) / (1 + di C + dj D),   where
//     A = (step_i.xy - p step_i.z) / depth,   C = step_i.z / depth,   likewise B and D for step_j,
//
// so that rounding scales with the triangle's extent in the image and not with the image's. With
// u = 2^-24, N = n (|A| + |B|) pixels and W = 1 + n (|C| + |D|) for n steps, and w the smallest
// denominator, the numerator is off by at most 3 u N, the denominator by 4 u W, and its reciprocal
// and the product by 6 u of the result; adding the fraction of p rounds twice more. The pixel is
// off by at most
//
//     u ((N / w) (9 + 4 W / w) + 3).
//
// Where that bound (taken with 12 and 6) exceeds MAX_ERROR_PX, some 700 px of extent, or where the
// cell is not safely in front of the camera (MIN_DEPTH_M), or where the depth varies so much that
// rounding might turn a denominator's sign (MAX_SWELL bounds W / w), the cell is left to the same
// program compiled with PRECISE, which projects every fragment in float64. hull/query/stencil.py decides by the same
// bound, a hair stricter, whether that program must run at all.

// INSERT

in dvec3 corner_a;
in dvec3 corner_b;
in dvec3 corner_c;
in uvec4 cell;

uniform dvec4 img_from_local[3];
uniform uint first_row;

out vec2 cell_origin_px;   // in the window
out int cell_rest;         // steps from the first sample to the diagonal; negative: do not draw
#if PRECISE
out dvec3 cell_x, cell_y, cell_depth;   // of the first sample, a step in i, a step in j
#else
out vec4 cell_pixel;       // fraction and whole pixel of the first sample
out vec4 cell_along;       // A, B
out vec2 cell_depths;      // C, D
#endif

dvec3 project_row(int row, dvec3 position, dvec3 step_i, dvec3 step_j) {
    dvec3 weights = img_from_local[row].xyz;
    return dvec3(dot(weights, position) + img_from_local[row].w, dot(weights, step_i),
                 dot(weights, step_j));
}

void main() {
    cell_origin_px = vec2(float(cell.x & 0xffffu), float((cell.x >> 16) + first_row));
    int u = int(cell.w);
    int rest = u - 1 - int(cell.y) - int(cell.z);

    dvec3 position, step_i, step_j;
    if (u == 1) {   // the centroid alone
        position = (corner_a + corner_b + corner_c) / 3.0LF;
        step_i = step_j = dvec3(0.0LF);
    } else {
        double per_edge = 1.0LF / double(u - 1);
        step_i = (corner_b - corner_a) * per_edge;
        step_j = (corner_c - corner_a) * per_edge;
        position = corner_a + double(cell.y) * step_i + double(cell.z) * step_j;
    }
    dvec3 row_x = project_row(0, position, step_i, step_j);
    dvec3 row_y = project_row(1, position, step_i, step_j);
    dvec3 row_z = project_row(2, position, step_i, step_j);

    // The corners of the cell: those of the triangle, or of a square that the diagonal may cut.
    int near = min(WINDOW - 1, rest);
    int beside = min(near, rest - near);
    double depth_min_m =
        row_z.x + min(0.0LF, double(near) * min(row_z.y, row_z.z));
    double depth_far_m = row_z.x + min(double(near) * row_z.y + double(beside) * row_z.z,
                                       double(beside) * row_z.y + double(near) * row_z.z);
    depth_min_m = min(depth_min_m, depth_far_m);

    bool is_single = false;
    if (depth_min_m > MIN_DEPTH_M) {
        double per_depth = 1.0LF / row_z.x;
        dvec2 pixel = dvec2(row_x.x, row_y.x) * per_depth;
        vec2 along_i = vec2((dvec2(row_x.y, row_y.y) - pixel * row_z.y) * per_depth);
        vec2 along_j = vec2((dvec2(row_x.z, row_y.z) - pixel * row_z.z) * per_depth);
        vec2 depths = vec2(row_z.yz * per_depth);
        float smallest = float(depth_min_m * per_depth);
        vec2 extent_px = float(near) * (abs(along_i) + abs(along_j)) / smallest;
        float swell = (1.0 + float(near) * (abs(depths.x) + abs(depths.y))) / smallest;
        float error_px = 5.97e-8 * (max(extent_px.x, extent_px.y) * (12.0 + 6.0 * swell) + 3.0);
        // Far outside, the whole pixel would not be a whole number in float32.
        is_single = error_px < MAX_ERROR_PX && swell < MAX_SWELL
                    && all(lessThan(abs(pixel), dvec2(1e6LF)));
#if !PRECISE
        dvec2 whole = floor(pixel);
        cell_pixel = vec4(vec2(pixel - whole), vec2(whole));
        cell_along = vec4(along_i, along_j);
        cell_depths = depths;
#endif
    }
#if PRECISE
    cell_x = row_x;
    cell_y = row_y;
    cell_depth = row_z;
    cell_rest = is_single ? -1 : rest;
#else
    cell_rest = is_single ? rest : -1;
#endif
}
