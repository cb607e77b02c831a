#version 300 es
// The splats over a plain colour, and if wanted a floor with soft shadows below the feet.
precision highp float;
precision highp sampler2D;

uniform sampler2D splats;        // premultiplied
uniform vec3 background;
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

float lines(vec2 p) {            // a thin line at every multiple of CELL, as wide as a pixel
  vec2 q = p / CELL, width = max(fwidth(q), 1e-4);
  vec2 near = abs(fract(q - 0.5) - 0.5) / width;
  return 1.0 - min(min(near.x, near.y), 1.0);
}

void main() {
  vec4 front = texelFetch(splats, ivec2(gl_FragCoord.xy), 0);
  vec3 behind = background;
  vec2 pixel = vec2(gl_FragCoord.x, size.y - gl_FragCoord.y);
  vec3 ray = transpose(camera_rotation) * vec3((pixel - K.zw) / K.xy, 1.0);
  float t = (floor_height - eye.y) / (ray.y > -1e-5 ? -1e-5 : ray.y);
  vec2 p = (eye + t * ray).xz;
  float line = lines(p);         // before any branch: derivatives need all pixels
  if (ground > 0.0 && ray.y < -1e-3 && t > 0.0) {
    float away = length(p - middle);
    float fade = smoothstep(3.2, 0.4, away) * smoothstep(0.0, 0.12, -normalize(ray).y);
    float light = dot(background, vec3(0.299, 0.587, 0.114));
    behind = mix(behind, light > 0.4 ? vec3(0.0) : vec3(1.0), ground * 0.085 * line * fade);
    float shadow = 0.0;
    for (int i = 0; i < 3; i++) {
      vec2 d = (p - shadows[i].xy) / SHADOW;
      shadow = max(shadow, shadows[i].z * exp(-0.5 * dot(d, d)));
    }
    behind *= 1.0 - ground * 0.3 * shadow;
  }
  result = vec4(front.rgb + (1.0 - front.a) * behind, 1.0);
}
