#pragma once
#define LOG_UINT8 1
#define LOG_UINT16 2
#define LOG_GROUP_START(group) static const struct { int type; const char *name; void *address; } logs_##group[] = {
#define LOG_ADD(type, name, address) {type, #name, address},
#define LOG_GROUP_STOP(group) {0, 0, 0}};
