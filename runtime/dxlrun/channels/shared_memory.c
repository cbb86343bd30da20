/* Shared memory: lock-free access by several processes, with the memory order that all processors require.
 *
 * ring.py has the layout of a ring, packets.py that of a batch. Shared words are atomic (C11). The writer publishes
 * a record by storing the head with release order, and a reader loads the head with acquire order before it reads
 * the record. The writer publishes the intent before it overwrites a record, and a reader loads the intent after
 * its copy. The memory may be damaged, so a reader bounds every offset and length by the arguments of the call.
 */

#include <stdatomic.h>
#include <stdint.h>
#include <string.h>

#ifndef SOURCE_CRC
#define SOURCE_CRC 0 /* CRC-32 of this file: compiled.py refuses an object of another version */
#endif
#ifndef LOAD /* tests/run/channels/ring_model.c replaces these with a model of the memory */
typedef _Atomic uint64_t Word;
#define LOAD(word, order) atomic_load_explicit(word, memory_order_##order)
#define STORE(word, value, order) atomic_store_explicit(word, value, memory_order_##order)
#define FENCE(order) atomic_thread_fence(memory_order_##order)
#define IS_WHOLE(crc, expected) ((crc) == (expected))
#define MOST_LOOKS 8 /* bounds the retries of a reader that the writer overtakes */
#endif
#define RING_HEADER 8 /* words */
#define ENTRY_HEADER 3
#define PACKETS 2 /* RecordKind */
#define MARK_BITS 16
enum { HEAD = 3, INTENT, LATEST, TAKEN, NUMBER };
enum { USED, BATCH_POSITION, EARLIER, CYCLE };
enum { POSITION, PASSED, KIND, LOST }; /* words of a reader: ring.py */
enum { NOTHING = -1, GAP = -2 };

static uint32_t crc32_table[16][256];

__attribute__((constructor)) static void fill_crc32_table(void)
{
    for (uint32_t i = 0; i < 256; i++) {
        uint32_t crc = i;
        for (int bit = 0; bit < 8; bit++)
            crc = crc & 1 ? crc >> 1 ^ 0xedb88320 : crc >> 1;
        crc32_table[0][i] = crc;
    }
    for (int n = 1; n < 16; n++)
        for (int i = 0; i < 256; i++)
            crc32_table[n][i] = crc32_table[n - 1][i] >> 8 ^ crc32_table[0][crc32_table[n - 1][i] & 0xff];
}

/* Update a CRC-32 (zlib's polynomial) sixteen bytes at a time. The caller inverts all bits before and after. */
static uint32_t crc32(uint32_t crc, const uint8_t *data, uint64_t size)
{
    for (; size >= 16; size -= 16, data += 16) {
        uint64_t words[2]; /* little-endian, as all shared data */
        memcpy(words, data, 16);
        words[0] ^= crc;
        crc = 0;
#pragma GCC unroll 8
        for (int n = 0; n < 8; n++)
            crc ^= crc32_table[15 - n][words[0] >> 8 * n & 0xff] ^ crc32_table[7 - n][words[1] >> 8 * n & 0xff];
    }
    while (size--)
        crc = crc >> 8 ^ crc32_table[0][(crc ^ *data++) & 0xff];
    return crc;
}

/* Return the CRC-32 of an entry's mark, number, length and kind, and of its payload. */
static uint32_t crc_of(const uint64_t *header, const uint8_t *payload, uint64_t size)
{
    return ~crc32(crc32(~0u, (const uint8_t *)header, 20), payload, size);
}

static uint64_t entry_size(uint64_t size) { return (8 * ENTRY_HEADER + size + 7) / 8 * 8; }

static Word *entry_at(Word *ring, uint64_t capacity, uint64_t position)
{
    return ring + RING_HEADER + position % capacity / 8;
}

/* Append a record to a ring; return its end position, or -1 if it is too long. */
int64_t dxl_append(Word *ring, uint64_t capacity, uint64_t longest, uint32_t kind, const uint8_t *payload,
                   uint64_t size)
{
    if (size > longest)
        return -1;
    uint64_t position = LOAD(&ring[HEAD], relaxed), end = position + entry_size(size);
    uint64_t intent = LOAD(&ring[INTENT], relaxed);
    if (intent < end || intent > position + entry_size(longest))
        intent = end; /* otherwise a writer died here in a longer record, whose intent must stay */
    uint32_t number = (uint32_t)LOAD(&ring[NUMBER], relaxed);
    uint64_t header[ENTRY_HEADER] = {position + 1, number | size << 32, kind};
    Word *entry = entry_at(ring, capacity, position);
    header[2] |= (uint64_t)crc_of(header, payload, size) << 32;
    STORE(&ring[INTENT], intent, relaxed);
    FENCE(release); /* a reader of the overwritten record sees the intent before the first changed word */
    for (int i = 0; i < ENTRY_HEADER; i++)
        STORE(entry++, header[i], relaxed);
    for (; size; entry++) {
        uint64_t word = 0, part = size < 8 ? size : 8;
        memcpy(&word, payload, part);
        STORE(entry, word, relaxed);
        payload += part;
        size -= part;
    }
    STORE(&ring[LATEST], position, relaxed);
    STORE(&ring[NUMBER], number + 1u, release); /* after `latest`: see dxl_read_next */
    STORE(&ring[HEAD], end, release);           /* after the whole record */
    return (int64_t)end;
}

/* Append the batch of packets on a desk to a ring, and clear the desk. */
void dxl_commit(Word *ring, uint64_t capacity, uint64_t longest, volatile uint64_t *desk)
{
    if (desk[USED]) {
        const uint8_t *batch = (const uint8_t *)(uintptr_t)(desk + EARLIER);
        int64_t position = dxl_append(ring, capacity, longest, PACKETS, batch, 16 + desk[USED]);
        /* If this process dies before the next store, `salvage` recognizes the batch by the ring's head. */
        atomic_signal_fence(memory_order_seq_cst);
        desk[USED] = 0; /* before the position, so that `salvage` never appends a batch twice */
        desk[BATCH_POSITION] = (uint64_t)position;
    }
    uint64_t number = desk[CYCLE] >> MARK_BITS;
    desk[CYCLE] = number << MARK_BITS; /* offset 0: the earlier cycle is unused */
    desk[EARLIER] = number;
}

/* Return 1 if the writer may have begun to overwrite the record at a position. Must be called after the copy. */
static int is_overwritten(Word *ring, uint64_t capacity, uint64_t position)
{
    FENCE(acquire);
    return LOAD(&ring[INTENT], relaxed) > position + capacity;
}

/* Copy the record at a position; return 0 if there is no complete one. */
static int copy_record(Word *ring, uint64_t capacity, uint64_t longest, uint64_t position, uint64_t *copy)
{
    Word *entry = entry_at(ring, capacity, position);
    for (int i = 0; i < ENTRY_HEADER; i++)
        copy[i] = LOAD(&entry[i], relaxed);
    uint64_t size = copy[1] >> 32;
    if (copy[0] != position + 1 || size > longest)
        return 0;
    for (uint64_t i = ENTRY_HEADER; i < entry_size(size) / 8; i++)
        copy[i] = LOAD(&entry[i], relaxed);
    return !is_overwritten(ring, capacity, position) &&
           IS_WHOLE(crc_of(copy, (const uint8_t *)(copy + ENTRY_HEADER), size), copy[2] >> 32);
}

/* Move the reader to the end of a copied record; return the size of its payload. */
static int64_t deliver(uint64_t *reader, uint64_t position, const uint64_t *copy)
{
    uint64_t size = copy[1] >> 32;
    reader[POSITION] = position + entry_size(size);
    reader[PASSED] = (uint32_t)copy[1] + 1u;
    reader[KIND] = (uint32_t)copy[2];
    return (int64_t)size;
}

/* Store the number of lost records, and move the reader to a record with a given number; return GAP. */
static int64_t declare(uint64_t *reader, uint64_t position, uint32_t number)
{
    uint32_t lost = number - (uint32_t)reader[PASSED];
    reader[POSITION] = position;
    reader[PASSED] = number;
    reader[LOST] = (int32_t)lost > 0 ? lost : 1;
    return GAP;
}

/* Copy the next record; return the size of its payload, NOTHING, or GAP. The search for the next complete record is
 * bounded by the longest record, both in distance and in copied bytes, so that a call has a bounded time. */
int64_t dxl_read_next(Word *ring, uint64_t capacity, uint64_t longest, uint64_t *reader, uint64_t *copy)
{
    if (LOAD(&ring[HEAD], acquire) <= reader[POSITION])
        return NOTHING;
    if (copy_record(ring, capacity, longest, reader[POSITION], copy) && (uint32_t)copy[1] == reader[PASSED])
        return deliver(reader, reader[POSITION], copy);
    for (int looks = 0; looks < MOST_LOOKS; looks++) {
        uint64_t intent = LOAD(&ring[INTENT], relaxed), head = LOAD(&ring[HEAD], acquire), copied = 0;
        uint64_t oldest = intent > capacity ? (intent - capacity + 7) / 8 * 8 : 0;
        if (oldest < reader[POSITION])
            oldest = reader[POSITION];
        for (uint64_t at = oldest; at < head && at <= oldest + entry_size(longest) && copied <= 4 * longest; at += 8) {
            if (LOAD(entry_at(ring, capacity, at), relaxed) != at + 1)
                continue;
            if (copy_record(ring, capacity, longest, at, copy)) {
                if ((int32_t)((uint32_t)copy[1] - (uint32_t)reader[PASSED]) > 0)
                    return declare(reader, at, (uint32_t)copy[1]);
                return deliver(reader, at, copy);
            }
            copied += copy[1] >> 32 <= longest ? copy[1] >> 32 : 0;
        }
        uint64_t number = LOAD(&ring[NUMBER], relaxed); /* that of the head, unless `latest` is beyond the head */
        if (!is_overwritten(ring, capacity, oldest) && LOAD(&ring[LATEST], relaxed) < head)
            return declare(reader, head, (uint32_t)number);
    }
    return NOTHING; /* the writer is faster: the next call reports the gap */
}

/* Copy the newest record, and move the reader to its end; return the size of its payload, or NOTHING. */
int64_t dxl_read_newest(Word *ring, uint64_t capacity, uint64_t longest, uint64_t *reader, uint64_t *copy)
{
    for (int looks = 0; looks < MOST_LOOKS; looks++) {
        uint64_t head = LOAD(&ring[HEAD], acquire), latest = LOAD(&ring[LATEST], relaxed);
        if (head <= reader[POSITION] || latest < reader[POSITION])
            break;
        if (latest < head && copy_record(ring, capacity, longest, latest, copy))
            return deliver(reader, latest, copy);
    }
    return NOTHING;
}

/* Load a word with acquire order: later reads are at least as new. */
uint64_t dxl_load(Word *word) { return LOAD(word, acquire); }

/* Store a word with release order: earlier writes become visible before it. */
void dxl_store(Word *word, uint64_t value) { STORE(word, value, release); }

/* Return the checksum of this source, which compiled.py compares. */
uint32_t dxl_source(void) { return SOURCE_CRC; }
