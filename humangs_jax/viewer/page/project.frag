#version 300 es
// Projects one Gaussian per pixel, in depth order. A Gaussian is skinned by the full linear part of
// its blended transform, and projected (EWA). The mathematics and its constants are those of
// humangs_jax/rendering/projection.py. This is a separate pass, so that it is done once per
// Gaussian and not for each corner. Integers hold the bits of floats, because not every GPU can
// draw to float textures.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

uniform usampler2D order;      // nearest first
uniform int count;
uniform usampler2D gaussians;  // three texels each, see scene.js
uniform sampler2D means;       // canonical, metres; the normal in 24 bits
uniform sampler2D harmonics;   // canonical: humangs_jax/rendering/gaussians.py; blocks of `rows`, one for each function
uniform int functions;         // 0: none
uniform int rows;
layout(std140) uniform Joints {
  vec4 joints[3 * 256];        // three rows of [linear | offset] per joint
};
uniform mat3 camera_rotation;  // of cam_from_world; columns here are its columns
uniform vec3 camera_offset;
uniform vec4 K;                // fx, fy, cx, cy, pixels
uniform vec2 size;             // pixels
uniform vec2 log_scale;        // lowest, highest
uniform vec2 color_range;
uniform vec3 first_light;      // humangs_jax/avatar/avatar.py: coefficients of x, y, z; all 0: colours stay
uniform vec3 more_light;       // of xy, yz, zx
uniform vec2 last_light;       // of zz - xx, 3 yy - 1
uniform vec2 shading_range;
uniform float near;
uniform float eps2d;
uniform float low_pass;                              // metres, 0: none
uniform float alpha_min;
uniform float jacobian_margin; // negative: none
uniform bool rotation_only;    // "rotation" skinning: the published network's

layout(location = 0) out uvec4 placed;  // centre, longer axis (one standard deviation), pixels
layout(location = 1) out uvec4 shape;   // shorter axis; where alpha falls below alpha_min, in standard deviations; opacity
layout(location = 2) out uvec4 color;

const int GAUSSIANS_PER_ROW = 1024;
const float LIGHT_LIMIT = 0.7;

mat3 matrix_of(vec4 q) {       // wxyz
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

// Returns the quaternion of a matrix by the best conditioned of four formulas. For a matrix that is
// no rotation, |q| is not 1 (geometry/quaternion.py).
vec4 quat_of(mat3 t) {
  mat3 m = transpose(t);       // m[row][column]
  vec4 a = sqrt(max(vec4(0.0), 1.0 + vec4(m[0][0] + m[1][1] + m[2][2], m[0][0] - m[1][1] - m[2][2],
                                          m[1][1] - m[0][0] - m[2][2], m[2][2] - m[0][0] - m[1][1])));
  float best = max(max(a.x, a.y), max(a.z, a.w));
  vec4 q;
  if (a.x == best) q = vec4(a.x * a.x, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]);
  else if (a.y == best) q = vec4(m[2][1] - m[1][2], a.y * a.y, m[1][0] + m[0][1], m[0][2] + m[2][0]);
  else if (a.z == best) q = vec4(m[0][2] - m[2][0], m[1][0] + m[0][1], a.z * a.z, m[2][1] + m[1][2]);
  else q = vec4(m[1][0] - m[0][1], m[2][0] + m[0][2], m[2][1] + m[1][2], a.w * a.w);
  return q / (2.0 * max(best, 0.1));
}

void add_harmonics(inout vec3 rgb, vec3 d, ivec2 place) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z, ring = 4.0 * zz - xx - yy;
  float values[15] = float[15](
    -0.48860251 * y, 0.48860251 * z, -0.48860251 * x,
    1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (2.0 * zz - xx - yy), -1.09254843 * x * z, 0.54627422 * (xx - yy),
    -0.59004359 * y * (3.0 * xx - yy), 2.89061144 * x * y * z, -0.45704580 * y * ring,
    0.37317633 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy), -0.45704580 * x * ring, 1.44530572 * z * (xx - yy),
    -0.59004359 * x * (xx - 3.0 * yy));
  for (int f = 0; f < functions; f++) rgb += values[f] * texelFetch(harmonics, place + ivec2(0, f * rows), 0).rgb;
  rgb = max(rgb, 0.0);
}

void main() {
  placed = shape = color = uvec4(0u);                // no extent: not drawn
  ivec2 slot = ivec2(gl_FragCoord.xy);
  if (slot.y * GAUSSIANS_PER_ROW + slot.x >= count) return;
  int i = int(texelFetch(order, slot, 0).r), column = i % GAUSSIANS_PER_ROW, row = i / GAUSSIANS_PER_ROW;
  uvec4 a = texelFetch(gaussians, ivec2(3 * column, row), 0);
  uvec4 b = texelFetch(gaussians, ivec2(3 * column + 1, row), 0);
  uvec4 c = texelFetch(gaussians, ivec2(3 * column + 2, row), 0);
  vec4 mean = texelFetch(means, ivec2(column, row), 0);
  int bits = int(mean.w);
  vec3 normal = vec3(bits >> 16, bits >> 8 & 255, bits & 255) - 127.0;
  mean.w = 1.0;
  vec2 scale_and_opacity = unpackUnorm2x16(a.y);
  vec3 scale = exp(log_scale.x + (log_scale.y - log_scale.x) * vec3(unpackUnorm2x16(a.x), scale_and_opacity.x));
  vec4 quat = normalize(vec4(unpackSnorm2x16(a.z), unpackSnorm2x16(a.w)));
  vec3 rgb = color_range.x + (color_range.y - color_range.x) * vec3(unpackUnorm2x16(b.x), unpackUnorm2x16(b.y).x);
  float shading = shading_range.x + (shading_range.y - shading_range.x) * unpackUnorm2x16(b.y).y;
  float opacity = scale_and_opacity.y;

  vec4 x = vec4(0.0), y = vec4(0.0), z = vec4(0.0);  // rows of the blended transform
  for (int k = 0; k < 8; k++) {
    uint pair = c[k / 2];
    float weight = float(k % 2 == 0 ? pair & 0xffffu : pair >> 16) / 65535.0;
    if (weight == 0.0) break;  // the largest come first
    int joint = 3 * int((b[2 + k / 4] >> uint(8 * (k % 4))) & 0xffu);
    x += weight * joints[joint];
    y += weight * joints[joint + 1];
    z += weight * joints[joint + 2];
  }
  vec3 p = camera_rotation * vec3(dot(x, mean), dot(y, mean), dot(z, mean)) + camera_offset;
  mat3 linear = transpose(mat3(x.xyz, y.xyz, z.xyz));

  if (!(p.z > near) || opacity <= alpha_min) return;

  normal = mat3(cross(linear[1], linear[2]), cross(linear[2], linear[0]), cross(linear[0], linear[1])) * normal;
  normal /= max(length(normal), 1e-12);
  float change = dot(first_light, normal) + dot(more_light, normal * normal.yzx) - shading
               + dot(last_light, vec2(normal.z * normal.z - normal.x * normal.x, 3.0 * normal.y * normal.y - 1.0));
  rgb = min(rgb * exp(clamp(change, -LIGHT_LIMIT, LIGHT_LIMIT)), max(rgb, 1.0));

  if (functions > 0)           // the direction of sight, turned back into the T-pose
    add_harmonics(rgb, normalize(p) * camera_rotation * matrix_of(normalize(quat_of(linear))), ivec2(column, row));

  mat3 turned = matrix_of(quat);
  turned = rotation_only ? matrix_of(quat_of(linear * turned)) : linear * turned;
  mat3 factor = camera_rotation * turned;            // columns: the Gaussian's axes in the camera's frame
  vec2 slope = p.xy / p.z, at = slope;
  if (jacobian_margin >= 0.0) {
    vec2 extra = jacobian_margin * 0.5 * size / K.xy;
    at = clamp(slope, -K.zw / K.xy - extra, (size - K.zw) / K.xy + extra);
  }
  vec3 m0 = (K.x / p.z) * vec3(factor[0].x - at.x * factor[0].z, factor[1].x - at.x * factor[1].z,
                               factor[2].x - at.x * factor[2].z) * scale;
  vec3 m1 = (K.y / p.z) * vec3(factor[0].y - at.y * factor[0].z, factor[1].y - at.y * factor[1].z,
                               factor[2].y - at.y * factor[2].z) * scale;
  float s00 = dot(m0, m0), s01 = dot(m0, m1), s11 = dot(m1, m1);
  vec3 across = cross(m0, m1);                       // a determinant without cancellation
  float determinant = dot(across, across) + eps2d * (s00 + s11) + eps2d * eps2d;
  if (low_pass > 0.0) {                              // as `rendering.projection` dims what the added variance makes larger
    float contained = eps2d * min(pow(low_pass * K.x / p.z, 2.0), 1.0);
    opacity *= sqrt((dot(across, across) + contained * (s00 + s11) + contained * contained) / determinant);
    if (opacity <= alpha_min) return;
  }
  s00 += eps2d;
  s11 += eps2d;
  float half_difference = 0.5 * (s00 - s11);
  float radius = length(vec2(half_difference, s01));
  float longer = 0.5 * (s00 + s11) + radius, shorter = determinant / longer;
  vec2 axis = half_difference > 0.0 ? vec2(half_difference + radius, s01) : vec2(s01, radius - half_difference);
  float norm = length(axis);
  axis = norm > 0.0 ? axis / norm : vec2(1.0, 0.0);
  placed = floatBitsToUint(vec4(K.xy * slope + K.zw, sqrt(longer) * axis));
  float reach = sqrt(2.0 * log(opacity / alpha_min));
  shape = floatBitsToUint(vec4(sqrt(shorter) * vec2(-axis.y, axis.x), reach, opacity));
  color = floatBitsToUint(vec4(rgb, 1.0));
}
