#pragma once
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#ifndef M2T
#define M2T(ms) ((unsigned int)(ms))
#endif
