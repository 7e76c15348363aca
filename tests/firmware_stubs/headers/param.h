#pragma once
#define PARAM_UINT8 8
#define PARAM_GROUP_START(group) static const struct { int type; const char *name; void *address; } params_##group[] = {
#define PARAM_ADD(type, name, address) {type, #name, address},
#define PARAM_GROUP_STOP(group) {0, 0, 0}};
