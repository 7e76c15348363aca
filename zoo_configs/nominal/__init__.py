"""Settings for one vehicle in still air, from the geometric expert: agents that see 18 features and remember nothing."""
