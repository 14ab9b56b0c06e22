// One observation: every token sees all keys. What pair.cu has for two. Macros, as functions change the code that ptxas
// makes.

#define OF_PAIR(...)
#define PREFIX_ROWS(a) int(*(a).length)
#define FIRST_ROW(a)
#define POSITION(a, prefix, token) (prefix + token)
