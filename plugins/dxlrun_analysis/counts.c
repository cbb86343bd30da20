/* Counts: a hash table with the number of times that each key was added. `counts.py` fills the struct. */

#include <stdint.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file: counts.py rejects an object of another version */
#endif

typedef struct {
    int64_t *keys, *counts; /* shape (slots,); a slot with a count of 0 is free */
    int64_t slots, used;    /* a power of two; slots that are not free */
    int64_t bits;           /* low bits of a key, which hold a value as its distance from the least one */
} Table;

uint32_t dxl_source(void)
{
    return SOURCE_CRC;
}

static void add_key(Table *table, int64_t key, int64_t count)
{
    uint64_t mask = (uint64_t)table->slots - 1, hash = (uint64_t)key * 0x9E3779B97F4A7C15; /* Fibonacci hashing */
    uint64_t slot = hash >> 32 & mask;
    while (table->counts[slot] && table->keys[slot] != key) {
        slot = (slot + 1) & mask;
    }
    table->used += !table->counts[slot];
    table->keys[slot] = key, table->counts[slot] += count;
}

/* Add values to their groups, of which negative ones are skipped. Return the number of values that were read until
 * the table was half full. */
int64_t counts_add(Table *table, const int64_t *groups, const int64_t *values, int64_t count)
{
    int64_t at = 0, half = (int64_t)1 << (table->bits - 1); /* values from -half to half - 1 */
    for (; at < count && 2 * table->used < table->slots; at++) {
        int64_t value = values[at] < -half ? -half : values[at] > half - 1 ? half - 1 : values[at];
        if (groups[at] >= 0) {
            add_key(table, (groups[at] << table->bits) + value + half, 1);
        }
    }
    return at;
}

/* Add all keys of another table. */
void counts_merge(Table *table, const Table *other)
{
    for (int64_t slot = 0; slot < other->slots; slot++) {
        if (other->counts[slot]) {
            add_key(table, other->keys[slot], other->counts[slot]);
        }
    }
}
