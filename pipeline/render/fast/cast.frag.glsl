#version 430
flat in vec4 share;
layout(location = 0) out vec4 blocked;
void main() { blocked = share; }
