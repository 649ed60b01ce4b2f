/* Assertions of the core that are counted, and return. For all sources: -include this file. */
#ifndef COUNT_ASSERTIONS_H
#define COUNT_ASSERTIONS_H

void count_assertion(int holds);
#define MAPLINES_ASSERT(condition) count_assertion((condition) ? 1 : 0)

#endif
