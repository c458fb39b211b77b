// Camera, light and tone mapping: what all passes over pixels share.
const float PI = 3.14159265358979;

uniform mat3 world_from_pixel;  // pixel (x, y, 1) to the ray's direction whose z-depth is 1
uniform vec3 eye;
uniform float step_px;          // from one sample to the next
uniform int encode;             // 1: sRGB, 0: linear light of a display

uniform sampler2D panorama;
uniform float panorama_rows;
uniform float turn;
uniform vec3 exposure;         // and white balance
uniform int has_ground;
uniform float height;
uniform vec3 bounce;
uniform vec3 harmonics[9];
uniform vec3 keys[KEYS];
uniform vec3 key_directions[KEYS];

vec3 ray_of(vec2 sample_at) { return world_from_pixel * vec3(sample_at * step_px, 1.0); }

vec3 to_linear(vec3 c) { return mix(pow((c + 0.055) / 1.055, vec3(2.4)), c / 12.92, lessThanEqual(c, vec3(0.04045))); }

vec3 to_srgb(vec3 c) {
    c = clamp(c, 0.0, 1.0);
    return mix(1.055 * pow(max(c, 1e-6), vec3(1.0 / 2.4)) - 0.055, c * 12.92, lessThanEqual(c, vec3(0.0031308)));
}

// exposure.show in Python says what the curve is.
vec3 tone_mapped(vec3 c) {
    c *= exposure;
    float peak = max(c.r, max(c.g, c.b));
    float d = 1.0 - SHOULDER;
    float squeezed = 1.0 - d * d / (max(peak, SHOULDER) + d - SHOULDER);
    vec3 bright = mix(c * (squeezed / max(peak, SHOULDER)), vec3(squeezed), 1.0 - 1.0 / (FADE * (peak - squeezed) + 1.0));
    return peak < SHOULDER ? c : bright;
}

vec3 shown(vec3 radiance) {
    vec3 c = tone_mapped(radiance);
    return encode == 1 ? to_srgb(c) : c;
}

vec3 sky(vec3 d, float level) {
    float azimuth = atan(d.y, d.x) - turn;
    float down = acos(clamp(d.z, -1.0, 1.0)) / PI;
    return textureLod(panorama, vec2(0.5 - azimuth / (2.0 * PI), down), level).rgb;
}

// Irradiance over pi.
vec3 smooth_light(vec3 n) {
    vec3 e = harmonics[0] + harmonics[1] * n.y + harmonics[2] * n.z + harmonics[3] * n.x;
    e += harmonics[4] * (n.x * n.y) + harmonics[5] * (n.y * n.z) + harmonics[6] * (3.0 * n.z * n.z - 1.0);
    e += harmonics[7] * (n.x * n.z) + harmonics[8] * (n.x * n.x - n.y * n.y);
    return max(e, vec3(0.0));
}

// The panorama's level whose texels are as wide as a highlight.
float highlight_level(float rough) {
    return clamp(log2(max(rough * rough, 0.01) * panorama_rows * 0.55), 0.0, 20.0);
}

// Karis, "Physically based shading on mobile" (2014).
float reflected_share(float rough, float n_v) {
    vec4 r = rough * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    float a = min(r.x * r.x, exp2(-9.28 * n_v)) * r.x + r.y;
    vec2 ab = vec2(-1.04, 1.04) * a + r.zw;
    return 0.04 * ab.x + ab.y;
}

// How much of a mirror image is left where key lights are hidden: what shows the light itself goes with it.
float unhidden(vec3 mirrored, vec2 open) {
    float first = smoothstep(0.6, 0.95, dot(mirrored, key_directions[0]));
    float second = smoothstep(0.6, 0.95, dot(mirrored, key_directions[1]));
    return mix(1.0, open.x, first) * mix(1.0, open.y, second);
}
