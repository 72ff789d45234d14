// The formulas are those of p2gs_jax/render (project.py, harmonics.py, tiles.py), and for the
// picture those of p2gs_jax/photometry/formation.py.

const VERSION = "#version 300 es\nprecision highp float;\nprecision highp int;\n" +
  "precision highp sampler2D;\nprecision highp usampler2D;\nprecision highp sampler2DArray;\n";

const FULL_SCREEN = VERSION + `
void main() {
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;

// Each Gaussian has a texel with its place in the picture and its radiance towards the camera.
const PROJECT = VERSION + `
uniform sampler2DArray splats;  // mean, log scales, quaternion, logit, then the harmonics
uniform int count, coefficients, activation;
uniform mat3 rotation;  // world to camera
uniform vec3 centre;    // of the camera
uniform vec4 lens;      // fx, fy, cx, cy
uniform vec2 size;
uniform float near, blur, logCutoff;
layout(location = 0) out uvec4 place;   // x, y, log opacity, log cutoff
layout(location = 1) out uvec4 shape;   // factor of the inverse covariance
layout(location = 2) out uvec4 light;   // radiance

const float C1 = 0.4886025119029199;

vec3 read(int layer, ivec2 at) { return texelFetch(splats, ivec3(at, layer), 0).xyz; }

vec3 harmonics(ivec2 at, vec3 d) {
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.28209479177387814 * read(4, at);
  if (coefficients > 1) sum += C1 * (z * read(6, at) - y * read(5, at) - x * read(7, at));
  if (coefficients > 4) {
    sum += 1.0925484305920792 * (x * y * read(8, at) - y * z * read(9, at) - x * z * read(11, at))
      + 0.31539156525252005 * (2.0 * zz - xx - yy) * read(10, at)
      + 0.5462742152960396 * (xx - yy) * read(12, at);
  }
  if (coefficients > 9) {
    sum += -0.5900435899266435 * (y * (3.0 * xx - yy) * read(13, at)
        + x * (xx - 3.0 * yy) * read(19, at))
      + 2.890611442640554 * x * y * z * read(14, at)
      - 0.4570457994644658 * (4.0 * zz - xx - yy) * (y * read(15, at) + x * read(17, at))
      + 0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * read(16, at)
      + 1.445305721320277 * z * (xx - yy) * read(18, at);
  }
  return sum;
}

vec3 radiance(vec3 v) {
  if (activation == 0) return exp(clamp(v, -30.0, 30.0));
  return max(v + 0.5, 0.0);
}

void main() {
  place = shape = light = uvec4(0u);
  ivec2 at = ivec2(gl_FragCoord.xy);
  place.z = floatBitsToUint(-100.0);  // log opacity of an invisible Gaussian
  if (at.y * textureSize(splats, 0).x + at.x >= count) return;
  vec3 mean = read(0, at), p = rotation * (mean - centre);
  if (!(p.z > near)) return;
  vec3 q = read(2, at);
  float w = sqrt(max(1.0 - dot(q, q), 0.0));
  mat3 Q = mat3(
    1.0 - 2.0 * (q.y * q.y + q.z * q.z), 2.0 * (q.x * q.y + w * q.z), 2.0 * (q.x * q.z - w * q.y),
    2.0 * (q.x * q.y - w * q.z), 1.0 - 2.0 * (q.x * q.x + q.z * q.z), 2.0 * (q.y * q.z + w * q.x),
    2.0 * (q.x * q.z + w * q.y), 2.0 * (q.y * q.z - w * q.x), 1.0 - 2.0 * (q.x * q.x + q.y * q.y));
  vec2 limit = 1.3 * size / (2.0 * lens.xy), tangent = clamp(p.xy / p.z, -limit, limit);
  mat3 axes = rotation * Q;
  vec3 s = exp(read(1, at));
  vec3 vx = lens.x / p.z * s * vec3(axes[0].x - tangent.x * axes[0].z,
    axes[1].x - tangent.x * axes[1].z, axes[2].x - tangent.x * axes[2].z);
  vec3 vy = lens.y / p.z * s * vec3(axes[0].y - tangent.y * axes[0].z,
    axes[1].y - tangent.y * axes[1].z, axes[2].y - tangent.y * axes[2].z);
  float xx = dot(vx, vx), yy = dot(vy, vy), xy = dot(vx, vy);
  vec3 minors = cross(vx, vy);
  float det = dot(minors, minors) + blur * (xx + yy) + blur * blur, cyy = yy + blur;
  if (!(det > 0.0) || isinf(det)) return;
  float a11 = sqrt(cyy / det);
  vec3 L = radiance(harmonics(at, normalize(mean - centre)));
  float logit = read(3, at).x;
  float opacity = min(logit, 0.0) - log(1.0 + exp(-abs(logit)));
  place = floatBitsToUint(vec4(lens.xy * p.xy / p.z + lens.zw, opacity, logCutoff));
  shape = floatBitsToUint(vec4(a11, -xy / cyy * a11, inversesqrt(cyy), 0.0));
  light = floatBitsToUint(vec4(L, 0.0));
}`;

const SPLAT_VERTEX = VERSION + `
uniform usampler2D place, shape, light;
uniform vec2 size;
layout(location = 0) in uint index;
flat out vec4 where;  // as in place: x, y, log opacity, log cutoff
flat out vec3 factor, radiance;

void main() {
  int width = textureSize(place, 0).x;
  ivec2 at = ivec2(int(index) % width, int(index) / width);
  where = uintBitsToFloat(texelFetch(place, at, 0));
  factor = uintBitsToFloat(texelFetch(shape, at, 0)).xyz;
  radiance = uintBitsToFloat(texelFetch(light, at, 0)).xyz;
  float reach = where.z - where.w;
  gl_Position = vec4(2.0, 2.0, 0.0, 1.0);
  if (!(reach > 0.0)) return;
  // The quad is a little wider than the ellipse, so that rounding does not cut pixels off.
  vec2 u = 1.001 * sqrt(2.0 * reach) * vec2(gl_VertexID % 2 * 2 - 1, gl_VertexID / 2 * 2 - 1);
  float y = u.y / factor.z;
  vec2 corner = where.xy + vec2((u.x - factor.y * y) / factor.x, y);
  gl_Position = vec4(corner / size * 2.0 - 1.0, 0.0, 1.0);
}`;

const SPLAT_FRAGMENT = VERSION + `
uniform float alphaMax, brightest;
flat in vec4 where;
flat in vec3 factor, radiance;
out vec4 color;

void main() {
  vec2 d = gl_FragCoord.xy - where.xy;
  float a = factor.x * d.x + factor.y * d.y, b = factor.z * d.y;
  float exponent = where.z - 0.5 * (a * a + b * b);
  if (!(exponent > where.w)) discard;
  float alpha = min(exp(exponent), alphaMax);
  color = vec4(min(radiance, brightest) * alpha, alpha);
}`;

// Exposure, gamma, curve and white point are applied here, and light is not changed elsewhere.
const DEVELOP = VERSION + `
uniform sampler2D linear, tables, photograph;
uniform vec2 pictureSize, canvasSize;
uniform vec3 factors;           // exposure times white balance
uniform int mode;               // 0 picture, 1 stops, 2 clipping, 3 exposed radiance as it is
uniform int curve;              // 0 linear, 1 power, 2 sRGB, 3 table
uniform float gamma, pivot, white;  // white: factor on the white point of the curve
uniform vec3 curveWhite;        // exposed radiance that the curve shows as 1
uniform vec3 tableFirst, tableStep;  // natural logarithms
uniform ivec3 tableRow;
uniform mat3 vignetting;        // a column of k1, k2, k3 for each channel
uniform vec3 frame;             // photograph pixels per canvas pixel; the photograph's width and height
uniform float split;            // share of the canvas that shows the photograph
uniform float most;             // largest display value
uniform vec3 stopColors[12];
out vec4 color;

const float GREY = 0.18;

vec3 light(vec2 at) {
  vec2 place = at * pictureSize / canvasSize - 0.5;
  vec2 corner = floor(place), share = place - corner;
  ivec2 low = ivec2(corner), top = ivec2(pictureSize) - 1;
  ivec2 a = clamp(low, ivec2(0), top), b = clamp(low + 1, ivec2(0), top);
  if (pictureSize == canvasSize) return texelFetch(linear, ivec2(at), 0).rgb;
  return mix(
    mix(texelFetch(linear, a, 0).rgb, texelFetch(linear, ivec2(b.x, a.y), 0).rgb, share.x),
    mix(texelFetch(linear, ivec2(a.x, b.y), 0).rgb, texelFetch(linear, b, 0).rgb, share.x),
    share.y);
}

float table(float logLinear, int channel) {
  float n = float(textureSize(tables, 0).x);
  float first = tableFirst[channel], place = (logLinear - first) / tableStep[channel];
  int row = tableRow[channel];
  if (place < 0.0) return texelFetch(tables, ivec2(0, row), 0).r * exp(logLinear - first);
  float left = clamp(floor(place), 0.0, n - 2.0);
  float a = texelFetch(tables, ivec2(int(left), row), 0).r;
  float b = texelFetch(tables, ivec2(int(left) + 1, row), 0).r;
  return a + (place - left) * (b - a);
}

// The curve is linear up to mid-grey, then a shoulder that reaches 1 at the chosen white point.
float shoulder(float x, float top) {
  if (white == 1.0 || x <= GREY || top <= GREY) return x;
  float t = (x - GREY) / (top - GREY), w = (white * top - GREY) / (top - GREY);
  return w <= 0.0 ? x : GREY + (top - GREY) * t * (1.0 + t / (w * w)) / (1.0 + t);
}

float tone(float exposed, int channel) {
  float x = log(max(shoulder(exposed, curveWhite[channel]), 1e-6));
  float logLinear = log(pivot) + (x - log(pivot)) * (2.2 / gamma);
  if (curve == 0) return exp(logLinear);
  if (curve == 1) return exp(logLinear / 2.2);
  if (curve == 3) return table(logLinear, channel);
  float linear = exp(logLinear);
  return linear <= 0.0031308 ? 12.92 * linear : 1.055 * exp(logLinear / 2.4) - 0.055;
}

vec3 develop(vec3 exposed) {
  return vec3(tone(exposed.r, 0), tone(exposed.g, 1), tone(exposed.b, 2));
}

void main() {
  vec2 at = gl_FragCoord.xy;
  if (mode != 3) at.y = canvasSize.y - at.y;  // row 0 of the canvas is at the bottom
  vec2 off = (at - canvasSize / 2.0) * frame.x;  // from the middle of the photograph
  vec2 inPhoto = off + frame.yz / 2.0;
  float r2 = min(4.0 * dot(off, off) / dot(frame.yz, frame.yz), 1.0);
  vec3 exposed = light(at) * factors;
  if (vignetting != mat3(0.0)) exposed *= exp(vec3(r2, r2 * r2, r2 * r2 * r2) * vignetting);
  if (mode == 3) {
    color = vec4(exposed, 1.0);
    return;
  }
  vec3 shown = develop(exposed);
  if (mode == 1) {
    float stops = log2(max(dot(exposed, vec3(0.2126, 0.7152, 0.0722)), 1e-12) / GREY);
    shown = stopColors[int(clamp(floor(stops), -6.0, 5.0)) + 6];
  } else if (mode == 2) {
    vec3 levels = 255.0 * shown;
    ivec2 pixel = ivec2(at);  // below, 60000 keeps a difference positive
    bool over = any(greaterThan(levels, vec3(254.5))), under = all(lessThanEqual(levels, vec3(0.5)));
    shown = clamp(shown, 0.0, 1.0);
    if (over && (pixel.x + pixel.y) / 6 % 2 == 0) shown = vec3(1.0, 0.15, 0.15);
    if (under && ((pixel.y - pixel.x + 60000) / 6) % 2 == 0) shown = vec3(0.15, 0.35, 1.0);
  }
  if (split > 0.0) {
    bool inside = all(greaterThanEqual(inPhoto, vec2(0.0))) && all(lessThan(inPhoto, frame.yz));
    float line = at.x - split * canvasSize.x;
    if (line < 0.0 && inside) shown = texture(photograph, inPhoto / frame.yz).rgb;
    if (abs(line) < 1.0) shown = vec3(1.0);
  }
  color = vec4(clamp(shown, 0.0, most), 1.0);
}`;
