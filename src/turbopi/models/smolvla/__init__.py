"""SmolVLA: LeRobot's small policy, exact. Images and text to a prefix, keys and values kept, a flow-matching expert."""
