/* What Kconfig writes for a platform: -DBRUSHLESS or -DUPGRADE_KIT, else a Crazyflie 2.1+. */
#pragma once
#define CONFIG_CONTROLLER_OOT 1
#define CONFIG_ENABLE_THRUST_BAT_COMPENSATED 1
#if defined(BRUSHLESS)
#define CONFIG_PLATFORM_CF21BL 1
#else
#define CONFIG_PLATFORM_CF2 1
#if defined(UPGRADE_KIT)
#define CONFIG_CRAZYFLIE_THRUST_UPGRADE_KIT 1
#else
#define CONFIG_CRAZYFLIE_21_PLUS 1
#endif
#endif
