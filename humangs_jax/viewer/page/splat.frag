#version 300 es
// Draws a splat with alpha = min(alpha_max, opacity exp(-d^2 / 2)), or nothing below alpha_min.
// Blending runs front to back: a splat counts as much as the splats in front of it let through.
precision highp float;

in vec2 offset;
flat in vec4 splat;
uniform float alpha_min;
uniform float alpha_max;
out vec4 premultiplied;

void main() {
  float alpha = splat.a * exp(-0.5 * dot(offset, offset));
  if (alpha < alpha_min) discard;
  alpha = min(alpha, alpha_max);
  premultiplied = vec4(splat.rgb * alpha, alpha);
}
