#version 430
// Colour, mask and depth of every pixel from the numbers of the faces that its samples see.
const int KEYS = 2;
const int KEY_SAMPLES = 10;
const int DIRECTIONS = 44;
const float PI = 3.14159265358979;

layout(std430, binding = 0) readonly buffer Vertices { vec4 vertices[]; };    // two a vertex: x y z u, normal v
layout(std430, binding = 1) readonly buffer Colours { uint colours[]; };
layout(std430, binding = 2) readonly buffer Faces { uvec4 faces[]; };         // three vertices and the part
layout(std430, binding = 3) readonly buffer Materials { vec4 materials[]; };  // linear colour, texture or -1

uniform sampler2D seen;         // supersample x supersample texels a pixel
uniform sampler2D seen_centre;  // one a pixel, through its centre
uniform sampler2DArray textures;
uniform sampler2DShadow atlas;
uniform sampler2D blocked;      // shares of light that the object keeps from the ground
uniform sampler2D panorama;
uniform sampler2D albedo;
uniform sampler2D slopes;

uniform int supersample;
uniform mat3 world_from_pixel;  // pixel (x, y, 1) to the ray's direction whose z-depth is 1
uniform vec3 eye;
uniform vec2 place;

uniform int kind;               // 0 own, 1 colour, 2 Voronoi
uniform vec3 palette[64];
uniform int n_colours;
uniform float cells;
uniform uint seed;
uniform float roughness;

uniform int has_ground;
uniform float height;
uniform float side;
uniform float ground_roughness;
uniform int has_bumps;
uniform float reach;

uniform float turn;
uniform float panorama_rows;
uniform float exposure;
uniform vec3 harmonics[9];
uniform vec3 keys[KEYS];
uniform vec3 key_directions[KEYS];
uniform vec3 bounce;
uniform vec4 across[DIRECTIONS];
uniform vec4 along[DIRECTIONS];
uniform vec4 toward[DIRECTIONS];   // w: the direction's weight is in weights; here 0
uniform vec4 tiles[DIRECTIONS];
uniform float weights[DIRECTIONS];
uniform float shadow_step;         // width of a shadow map's texel in the world

layout(location = 0) out vec4 out_colour;
layout(location = 1) out float out_depth;

// ---- colour

vec3 to_linear(vec3 c) { return mix(pow((c + 0.055) / 1.055, vec3(2.4)), c / 12.92, lessThanEqual(c, vec3(0.04045))); }
vec3 to_srgb(vec3 c) {
    return mix(1.055 * pow(max(c, 1e-6), vec3(1.0 / 2.4)) - 0.055, c * 12.92, lessThanEqual(c, vec3(0.0031308)));
}

// Khronos PBR Neutral: colours below 0.8 stay true, what is brighter is compressed and loses its hue.
vec3 tone_mapped(vec3 c) {
    const float START = 0.8 - 0.04, FADE = 0.15;
    float low = min(c.r, min(c.g, c.b));
    c -= low < 0.08 ? low - 6.25 * low * low : 0.04;
    float peak = max(c.r, max(c.g, c.b));
    if (peak < START) return c;
    float d = 1.0 - START;
    float squeezed = 1.0 - d * d / (peak + d - START);
    c *= squeezed / peak;
    return mix(c, vec3(squeezed), 1.0 - 1.0 / (FADE * (peak - squeezed) + 1.0));
}

// ---- light

vec3 sky(vec3 d, float level) {
    float azimuth = atan(d.y, d.x) - turn;
    float down = acos(clamp(d.z, -1.0, 1.0)) / PI;
    return textureLod(panorama, vec2(0.5 - azimuth / (2.0 * PI), down), level).rgb;
}

// What a ray that leaves the scene meets: the panorama, or where there is ground its mean radiance.
vec3 surroundings(vec3 d, float level) {
    vec3 radiance = sky(has_ground == 1 ? vec3(d.xy, max(d.z, 0.0)) / max(length(vec3(d.xy, max(d.z, 0.0))), 1e-6) : d, level);
    if (has_ground == 0) return radiance;
    float soft = 0.02 + 0.06 * level;
    return mix(bounce, radiance, smoothstep(-soft, soft, d.z));
}

vec3 smooth_light(vec3 n) {
    vec3 e = harmonics[0] + harmonics[1] * n.y + harmonics[2] * n.z + harmonics[3] * n.x;
    e += harmonics[4] * (n.x * n.y) + harmonics[5] * (n.y * n.z) + harmonics[6] * (3.0 * n.z * n.z - 1.0);
    e += harmonics[7] * (n.x * n.z) + harmonics[8] * (n.x * n.x - n.y * n.y);
    return max(e, vec3(0.0));
}

float lit(int i, vec4 p) {
    vec2 xy = vec2(dot(across[i], p), dot(along[i], p));
    float z = -dot(toward[i], p);
    vec2 uv = 0.5 + 0.5 * (clamp(xy, -1.0, 1.0) * tiles[i].xy + tiles[i].zw);
    return textureLod(atlas, vec3(uv, 0.5 + 0.5 * z), 0.0);
}

float highlight_level(float rough) {
    float spread = max(rough * rough, 0.01);
    return clamp(log2(spread * panorama_rows * 0.55), 0.0, 20.0);
}

// Karis, "Physically based shading on mobile" (2014).
float reflected_share(float rough, float n_v) {
    vec4 r = rough * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    float a = min(r.x * r.x, exp2(-9.28 * n_v)) * r.x + r.y;
    vec2 ab = vec2(-1.04, 1.04) * a + r.zw;
    return 0.04 * ab.x + ab.y;
}

// ---- the object

uvec3 scrambled(uvec3 v) {  // pcg3d: Jarzynski and Olano, JCGT 2020; integers, so the same everywhere
    v = v * 1664525u + 1013904223u;
    v.x += v.y * v.z; v.y += v.z * v.x; v.z += v.x * v.y;
    v ^= v >> 16u;
    v.x += v.y * v.z; v.y += v.z * v.x; v.z += v.x * v.y;
    return v;
}

vec3 voronoi(vec3 p) {
    p *= cells;
    vec3 base = floor(p);
    float best = 1e9;
    uint owner = 0u;
    for (int i = 0; i < 27; i++) {
        vec3 cell = base + vec3(i % 3 - 1, (i / 3) % 3 - 1, i / 9 - 1);
        uvec3 h = scrambled(uvec3(ivec3(cell) + 32768) + uvec3(seed, seed >> 10u, seed >> 20u));
        vec3 apart = cell + vec3(h >> 8u) * (1.0 / 16777216.0) - p;
        float d = dot(apart, apart);
        if (d < best) { best = d; owner = scrambled(h).x >> 8u; }
    }
    return palette[int(owner % uint(n_colours))];
}

struct Hit {
    float z;        // z-depth: the point is eye + z * ray
    vec3 point;
    vec3 normal;    // of the face, towards the eye
    vec3 smoothed;  // of the vertices
    vec3 share;     // barycentric coordinates
    uvec4 face;
};

vec3 shares_at(vec3 ray, vec3 start, vec3 e1, vec3 e2, vec3 n, out float z) {
    // The ray's point next to the first vertex, and from there to the plane: small numbers, small errors.
    float guess = dot(start, ray) / dot(ray, ray);
    vec3 rest = start - guess * ray;
    float slope = dot(n, ray);
    z = guess + dot(n, rest) / (abs(slope) < 1e-30 ? 1e-30 : slope);
    vec3 inside = (z - guess) * ray - rest;
    float area = max(dot(n, n), 1e-36);
    float b = dot(cross(inside, e2), n) / area;
    float c = dot(cross(e1, inside), n) / area;
    return vec3(1.0 - b - c, b, c);
}

Hit hit_of(int number, vec3 ray, vec3 forward) {
    Hit hit;
    hit.face = faces[number];
    uint a = 2u * hit.face.x, b = 2u * hit.face.y, c = 2u * hit.face.z;
    vec3 A = vertices[a].xyz, B = vertices[b].xyz, C = vertices[c].xyz;
    vec3 e1 = B - A, e2 = C - A;
    // A small face's cross product is near the smallest floats: brought to a size of about 1
    float size = max(max(max(abs(e1.x), abs(e1.y)), abs(e1.z)), max(max(abs(e2.x), abs(e2.y)), abs(e2.z)));
    float grow = 1.0 / max(size, 1e-20);
    e1 *= grow; e2 *= grow;
    vec3 n = cross(e1, e2);
    vec3 from_eye = A - eye;
    float z;
    vec3 s = shares_at(ray, from_eye * grow, e1, e2, n, z);
    z /= grow;
    // Samples at a face's rim may lie past it by the rasteriser's rounding: no farther than its vertices do
    vec3 depths = vec3(dot(from_eye, forward), dot(B - eye, forward), dot(C - eye, forward));
    float low = min(depths.x, min(depths.y, depths.z)), high = max(depths.x, max(depths.y, depths.z));
    hit.z = clamp(z, low, high);
    hit.point = eye + hit.z * ray;
    s = clamp(s, 0.0, 1.0);
    hit.share = s / (s.x + s.y + s.z);
    float length2 = dot(n, n);
    hit.normal = length2 > 0.0 ? n * inversesqrt(length2) : -normalize(ray);
    if (dot(hit.normal, ray) > 0.0) hit.normal = -hit.normal;
    vec3 m = vertices[a + 1u].xyz * hit.share.x + vertices[b + 1u].xyz * hit.share.y + vertices[c + 1u].xyz * hit.share.z;
    length2 = dot(m, m);
    m = length2 > 1e-8 ? m * inversesqrt(length2) : hit.normal;
    hit.smoothed = dot(m, hit.normal) < 0.0 ? -m : m;
    return hit;
}

vec2 uv_of(uvec4 face, vec3 s) {
    uint a = 2u * face.x, b = 2u * face.y, c = 2u * face.z;
    return s.x * vec2(vertices[a].w, vertices[a + 1u].w) + s.y * vec2(vertices[b].w, vertices[b + 1u].w) +
           s.z * vec2(vertices[c].w, vertices[c + 1u].w);
}

vec3 own_colour(Hit hit, vec3 ray, vec3 ray_right, vec3 ray_down) {
    vec4 material = materials[hit.face.w];
    vec3 s = hit.share;
    vec3 mixed = s.x * unpackUnorm4x8(colours[hit.face.x]).rgb + s.y * unpackUnorm4x8(colours[hit.face.y]).rgb +
                 s.z * unpackUnorm4x8(colours[hit.face.z]).rgb;
    vec3 colour = material.rgb * to_linear(mixed);
    if (material.w >= 0.0) {
        vec3 A = vertices[2u * hit.face.x].xyz;
        vec3 e1 = vertices[2u * hit.face.y].xyz - A, e2 = vertices[2u * hit.face.z].xyz - A;
        vec3 n = cross(e1, e2);
        float z;
        vec2 uv = uv_of(hit.face, s);
        vec2 right = uv_of(hit.face, shares_at(ray_right, A - eye, e1, e2, n, z)) - uv;
        vec2 down = uv_of(hit.face, shares_at(ray_down, A - eye, e1, e2, n, z)) - uv;
        vec3 at = vec3(uv.x, 1.0 - uv.y, material.w);
        colour *= to_linear(textureGrad(textures, at, vec2(right.x, -right.y), vec2(down.x, -down.y)).rgb);
    }
    return colour;
}

vec3 object_radiance(Hit hit, vec3 ray, vec3 ray_right, vec3 ray_down) {
    vec3 base = kind == 0 ? own_colour(hit, ray, ray_right, ray_down) : kind == 1 ? palette[0] : voronoi(hit.point);
    vec3 n = hit.smoothed;
    vec4 p = vec4(hit.point + hit.normal * (1.6 * shadow_step), 1.0);
    vec3 diffuse = vec3(0.0);
    float whole = 0.0, open = 0.0;
    for (int k = 0; k < KEYS; k++) {
        float facing = min(dot(n, key_directions[k]), 4.0 * dot(hit.normal, key_directions[k]));
        if (weights[k * KEY_SAMPLES] <= 0.0 || facing <= 0.0) continue;
        float light = 0.0;
        for (int i = k * KEY_SAMPLES; i < (k + 1) * KEY_SAMPLES; i++) light += weights[i] * lit(i, p);
        diffuse += keys[k] * (facing * light);
    }
    for (int i = KEYS * KEY_SAMPLES; i < DIRECTIONS; i++) {
        float share = weights[i] * dot(n, toward[i].xyz);
        if (share <= 0.0) continue;
        whole += share;
        open += share * lit(i, p);
    }
    float openness = whole > 0.0 ? open / whole : 1.0;
    vec3 smooth_part = smooth_light(n);
    diffuse += smooth_part * openness;
    vec3 view = -normalize(ray);
    float n_v = clamp(dot(n, view), 0.0, 1.0);
    vec3 mirrored = surroundings(reflect(-view, n), highlight_level(roughness));
    return base * diffuse + mirrored * (reflected_share(roughness, n_v) * openness);
}

// ---- the ground

vec3 ground_radiance(vec3 ray, vec3 ray_right, vec3 ray_down, float z) {
    vec2 at = eye.xy + z * ray.xy;
    vec2 g = (at + place) / side;
    float h = height - eye.z;
    vec2 right = (eye.xy + h / ray_right.z * ray_right.xy - at) / side;
    vec2 down = (eye.xy + h / ray_down.z * ray_down.xy - at) / side;
    vec2 flip = vec2(1.0, -1.0);  // the picture's first row is its upper edge
    vec3 base = textureGrad(albedo, g * flip, right * flip, down * flip).rgb;
    vec3 n = vec3(0.0, 0.0, 1.0);
    if (has_bumps == 1) {
        vec2 slope = textureGrad(slopes, g * flip, right * flip, down * flip).rg;
        n = normalize(vec3(-slope, 1.0));
    }
    vec2 spot = at / reach;
    float rim = max(abs(spot.x), abs(spot.y));
    vec3 kept = rim < 1.0 ? textureLod(blocked, 0.5 + 0.5 * spot, 0.0).rgb * (1.0 - smoothstep(0.8, 1.0, rim)) : vec3(0.0);
    vec3 diffuse = smooth_light(n) * (1.0 - kept.r);
    diffuse += keys[0] * (max(dot(n, key_directions[0]), 0.0) * (1.0 - kept.g));
    diffuse += keys[1] * (max(dot(n, key_directions[1]), 0.0) * (1.0 - kept.b));
    vec3 view = -normalize(ray);
    if (eye.z < height) view.z = -view.z;
    vec3 mirrored = reflect(-view, n);
    mirrored.z = abs(mirrored.z);
    float share = reflected_share(ground_roughness, clamp(dot(n, view), 0.0, 1.0));
    vec3 radiance = base * diffuse + sky(mirrored, highlight_level(ground_roughness)) * (share * (1.0 - kept.r) * (1.0 - kept.g));
    // Far away it goes over into the panorama, as in haze
    float far = smoothstep(10.0, 60.0, length(at - eye.xy));
    return far > 0.0 ? mix(radiance, sky(normalize(ray), 2.0), far) : radiance;
}

// ---- a pixel

float ground_depth(vec3 ray) {
    float z = has_ground == 1 ? (height - eye.z) / ray.z : -1.0;
    return z > 0.0 && z < 1e6 ? z : 0.0;
}

// Whether the object's point is seen before the ground: what lies on the plane is seen.
bool above(Hit hit, float plane) {
    return plane <= 0.0 || (hit.point.z - height) * (eye.z < height ? -1.0 : 1.0) > -1e-4;
}

void main() {
    vec2 corner = floor(gl_FragCoord.xy);
    vec3 forward = normalize(cross(world_from_pixel[0], world_from_pixel[1]));
    vec3 dx = world_from_pixel[0], dy = world_from_pixel[1];
    vec3 centre = world_from_pixel * vec3(corner + 0.5, 1.0);
    float plane = ground_depth(centre);
    int number = int(texelFetch(seen_centre, ivec2(corner), 0).r) - 1;
    out_depth = plane;
    float mask = 0.0;
    Hit first;
    if (number >= 0) {
        first = hit_of(number, centre, forward);
        if (above(first, plane)) { out_depth = first.z; mask = 1.0; }
    }
    float side_px = 1.0 / float(supersample);
    vec3 object = vec3(0.0);
    vec2 ground_at = vec2(0.0), sky_at = vec2(0.0);
    float n_ground = 0.0, n_sky = 0.0;
    for (int i = 0; i < supersample * supersample; i++) {
        ivec2 step = ivec2(i % supersample, i / supersample);
        vec2 at = corner + (vec2(step) + 0.5) * side_px;
        vec3 ray = world_from_pixel * vec3(at, 1.0);
        float z = ground_depth(ray);
        int face = int(texelFetch(seen, ivec2(corner) * supersample + step, 0).r) - 1;
        if (face >= 0) {
            Hit hit = hit_of(face, ray, forward);
            if (above(hit, z)) {
                vec3 colour = object_radiance(hit, ray, ray + dx * side_px, ray + dy * side_px);
                object += tone_mapped(exposure * colour);
                continue;
            }
        }
        if (z > 0.0) { ground_at += at; n_ground += 1.0; } else { sky_at += at; n_sky += 1.0; }
    }
    // Ground and sky are smooth between their texels: one sample in the middle of what is seen of them does
    vec3 sum = object;
    if (n_ground > 0.0) {
        vec3 ray = world_from_pixel * vec3(ground_at / n_ground, 1.0);
        sum += n_ground * tone_mapped(exposure * ground_radiance(ray, ray + dx, ray + dy, ground_depth(ray)));
    }
    if (n_sky > 0.0) {
        vec3 ray = normalize(world_from_pixel * vec3(sky_at / n_sky, 1.0));
        sum += n_sky * tone_mapped(exposure * sky(ray, 0.0));
    }
    out_colour = vec4(to_srgb(clamp(sum * side_px * side_px, 0.0, 1.0)), mask);
}
