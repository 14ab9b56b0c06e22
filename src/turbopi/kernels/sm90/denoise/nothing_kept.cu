// A loop that keeps nothing for a way back. What kept.cu has. A macro, so that the machine code is what it is without.

#define KEEP(...)
