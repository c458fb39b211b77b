#version 430
// Depth of the object seen along every direction, each in its tile of an atlas: one instance a direction.
uniform vec4 across[DIRECTIONS];  // row of the matrix that maps a point to the tile's x in [-1, 1]
uniform vec4 along[DIRECTIONS];
uniform vec4 toward[DIRECTIONS];
uniform vec4 tiles[DIRECTIONS];   // scale and shift of the tile in the atlas
uniform int used[DIRECTIONS];
in vec3 position;
void main() {
    int i = used[gl_InstanceID];
    vec4 p = vec4(position, 1.0);
    vec2 xy = vec2(dot(across[i], p), dot(along[i], p));
    gl_Position = vec4(xy * tiles[i].xy + tiles[i].zw, -dot(toward[i], p), 1.0);
}
