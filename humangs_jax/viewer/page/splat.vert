#version 300 es
// Places the corners of the rectangle around the ellipse in which a splat's alpha is at least
// alpha_min.
precision highp float;
precision highp usampler2D;

uniform usampler2D placed_splats;
uniform usampler2D shape_splats;
uniform usampler2D color_splats;
uniform vec2 size;      // pixels

out vec2 offset;        // from the centre, in standard deviations along the axes
flat out vec4 splat;    // colour and opacity

const int GAUSSIANS_PER_ROW = 1024;

void main() {
  int i = gl_VertexID >> 2;
  ivec2 slot = ivec2(i % GAUSSIANS_PER_ROW, i / GAUSSIANS_PER_ROW);
  vec4 placed = uintBitsToFloat(texelFetch(placed_splats, slot, 0));
  vec4 shape = uintBitsToFloat(texelFetch(shape_splats, slot, 0));
  vec4 color = uintBitsToFloat(texelFetch(color_splats, slot, 0));
  offset = (vec2(gl_VertexID & 1, (gl_VertexID >> 1) & 1) * 2.0 - 1.0) * shape.z;
  splat = vec4(color.rgb, shape.w);
  vec2 pixel = placed.xy + offset.x * placed.zw + offset.y * shape.xy;
  // pixel centres are at +0.5 in both; our y points down, that of OpenGL up
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}
