"""The demonstration `reem demo`: an arm, its camera and its controller, which share nothing but REEM."""
