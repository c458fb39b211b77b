// The point of a face that a ray meets.
layout(std430, binding = 0) readonly buffer Vertices { vec4 vertices[]; };    // two a vertex: x y z u, normal v
layout(std430, binding = 1) readonly buffer Faces { uvec4 faces[]; };         // three vertices and the part

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
    vec3 widest = max(abs(e1), abs(e2));
    float grow = 1.0 / max(max(max(widest.x, widest.y), widest.z), 1e-20);
    e1 *= grow;
    e2 *= grow;
    vec3 n = cross(e1, e2);
    vec3 from_eye = A - eye;
    float z;
    vec3 s = shares_at(ray, from_eye * grow, e1, e2, n, z);
    // Samples at a face's rim may lie past it by the rasteriser's rounding: no farther than its vertices do
    vec3 depths = vec3(dot(from_eye, forward), dot(B - eye, forward), dot(C - eye, forward));
    float low = min(depths.x, min(depths.y, depths.z)), high = max(depths.x, max(depths.y, depths.z));
    hit.z = clamp(z / grow, low, high);
    hit.point = eye + hit.z * ray;
    s = clamp(s, 0.0, 1.0);
    hit.share = s / (s.x + s.y + s.z);
    float squared = dot(n, n);
    hit.normal = squared > 0.0 ? n * inversesqrt(squared) : -normalize(ray);
    if (dot(hit.normal, ray) > 0.0) hit.normal = -hit.normal;
    vec3 m = vertices[a + 1u].xyz * hit.share.x + vertices[b + 1u].xyz * hit.share.y;
    m += vertices[c + 1u].xyz * hit.share.z;
    squared = dot(m, m);
    m = squared > 1e-8 ? m * inversesqrt(squared) : hit.normal;
    hit.smoothed = dot(m, hit.normal) < 0.0 ? -m : m;
    return hit;
}
