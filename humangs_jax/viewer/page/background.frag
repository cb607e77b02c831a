#version 300 es
// Lays the splats over a plain colour, or over nothing, and optionally over a floor with soft
// shadows below the feet.
precision highp float;
precision highp sampler2D;

uniform sampler2D splats;        // premultiplied
uniform vec3 background;
uniform float opaque;            // 0: nothing is behind the splats, and the result is premultiplied
uniform float ground;            // 0: none, 1: full
uniform float floor_height;
uniform vec3 eye;
uniform mat3 camera_rotation;
uniform vec4 K;
uniform vec2 size;
uniform vec3 shadows[3];         // x, z in metres, strength
uniform vec2 middle;             // x, z where the floor is clearest
out vec4 result;

const float CELL = 0.5, SHADOW = 0.17;

// Returns thin lines at the multiples of CELL, 0 to 1. width: size of a pixel on the floor, metres.
float lines(vec2 p, vec2 width) {
  vec2 away = abs(fract(p / CELL - 0.5) - 0.5) * CELL / max(width, vec2(1e-5));
  return 1.0 - min(min(away.x, away.y), 1.0);
}

// Returns lines and shadows of the floor, premultiplied, for laying over the plain colour.
vec4 floor_layer(vec3 plain, vec3 ray) {
  float t = (floor_height - eye.y) / ray.y;
  if (ray.y > -1e-3 || t < 0.0) return vec4(0.0);    // seen from below, or above the horizon
  vec2 p = (eye + t * ray).xz;
  float fade = smoothstep(3.2, 0.4, length(p - middle)) * smoothstep(0.0, 0.12, -normalize(ray).y);
  if (fade == 0.0) return vec4(0.0);
  // how p moves from one pixel to the next, in both directions of the image
  vec3 right = vec3(camera_rotation[0][0], camera_rotation[1][0], camera_rotation[2][0]) / K.x;
  vec3 down = vec3(camera_rotation[0][1], camera_rotation[1][1], camera_rotation[2][1]) / K.y;
  vec2 dx = t * (right - ray * (right.y / ray.y)).xz, dy = t * (down - ray * (down.y / ray.y)).xz;
  float light = dot(plain, vec3(0.299, 0.587, 0.114)), line = lines(p, abs(dx) + abs(dy));
  vec3 ink = light > 0.4 ? vec3(0.0) : vec3(1.0);
  float inked = ground * 0.085 * line * fade;
  float shadow = 0.0;
  for (int i = 0; i < 3; i++) {
    vec2 d = (p - shadows[i].xy) / SHADOW;
    shadow = max(shadow, shadows[i].z * exp(-0.5 * dot(d, d)));
  }
  float lit = 1.0 - ground * 0.3 * shadow;
  return vec4(ink * inked * lit, 1.0 - (1.0 - inked) * lit);
}

void main() {
  vec4 front = texelFetch(splats, ivec2(gl_FragCoord.xy), 0);
  vec4 behind = opaque * vec4(background, 1.0);
  if (ground > 0.0) {
    vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
    vec3 ray = transpose(camera_rotation) * vec3((pixel - K.zw) / K.xy, 1.0);
    vec4 layer = floor_layer(background, ray);
    behind = layer + (1.0 - layer.a) * behind;
  }
  result = front + (1.0 - front.a) * behind;
}
