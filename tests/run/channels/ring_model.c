/* A model of the ring's memory: runs the code of shared_memory.c in every order that C11 allows, and so ARM.
 *
 * The one writer reads nothing that others write. So it runs first, and each word keeps all values that it ever had,
 * each with the view of the writer that comes with it: at a release store what was stored before it, else what was
 * before the last release fence. A reader's load returns any value that is no older than the reader's view of that
 * word; acquiring takes over the view that came with the value. That is C11 without read-modify-writes and fences of
 * total order; readers store nothing that others read, so two of them have no more behaviours side by side than one
 * after the other: one reads all, one the newest. What a call may return, and the states it leaves, are explored
 * exhaustively, each state once. The checksum is left out: nothing may depend on it.
 *
 * A record may be delivered only as it was appended and in order, and declared lost only when the reader has seen
 * that it is overwritten; when all is seen at last, each was delivered or declared. The writer may die at any store,
 * and another one go on behind it, with records of no payload.
 */
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define MOST_WORDS 40
#define MOST_VALUES 8
#define MOST_STATES 400000
#define MOST_LOADS 4000

typedef uint64_t Word;
typedef struct {
    uint8_t seen[MOST_WORDS];
} View;
typedef enum { relaxed, acquire, release } Order;
typedef struct {
    uint64_t reader[4];
    View view;
} State;

static Word memory[MOST_WORDS];
static uint64_t values[MOST_WORDS][MOST_VALUES];
static View shown[MOST_WORDS][MOST_VALUES];
static uint8_t newest[MOST_WORDS];
static View writer, fenced, view, pending;
static int stores, last_store, writing;
static uint8_t choice[MOST_LOADS], limit[MOST_LOADS];
static int depth, length;
static long loads;

static void join(View *to, const View *from)
{
    for (int i = 0; i < MOST_WORDS; i++)
        if (from->seen[i] > to->seen[i])
            to->seen[i] = from->seen[i];
}

static uint64_t load(const Word *word, Order order)
{
    long at = word - memory;
    loads++;
    if (writing)
        return values[at][newest[at]];
    int first = view.seen[at], chosen = newest[at];
    if (length < 0) /* all is seen */
        return values[at][chosen];
    if (depth == length) {
        choice[length] = 0;
        limit[length++] = (uint8_t)(newest[at] - first + 1);
    }
    chosen = first + choice[depth++];
    view.seen[at] = (uint8_t)chosen;
    join(order == acquire ? &view : &pending, &shown[at][chosen]);
    return values[at][chosen];
}

static void store(const Word *word, uint64_t value, Order order)
{
    long at = word - memory;
    if (stores++ >= last_store)
        return;
    int now = ++newest[at];
    values[at][now] = value;
    writer.seen[at] = (uint8_t)now;
    shown[at][now] = order == release ? writer : fenced;
    shown[at][now].seen[at] = (uint8_t)now;
}

static void fence(Order order)
{
    if (order == release)
        fenced = writer;
    else
        join(&view, &pending);
}

#define LOAD(word, order) load(word, order)
#define STORE(word, value, order) store(word, value, order)
#define FENCE(order) fence(order)
#define IS_WHOLE(crc, expected) ((void)(crc), 1)
#define MOST_LOOKS 2
#include SOURCE

static uint64_t capacity, longest, start[16], size[16], published;
static int records, wrong, died, nameless; /* a record that has a number and nothing else: its writer died */
static State states[MOST_STATES];
static int32_t hashed[1 << 20];
static int state_count;
static long executions;

static uint64_t payload_of(uint64_t number, uint64_t word) { return (number + 1) << 32 | 0xffff0000 | word; }

static void fail(const char *what, int64_t found, const State *from, const uint64_t *reader)
{
    if (!wrong++)
        printf("%s: answered %lld at position %llu, record %llu; then at %llu, record %llu; a writer died at store %d\n",
               what, (long long)found, (unsigned long long)from->reader[POSITION],
               (unsigned long long)from->reader[PASSED], (unsigned long long)reader[POSITION],
               (unsigned long long)reader[PASSED], died);
}

/* Checks what a call returned; `in_order`: it reads all records. */
static void check(int64_t found, const State *from, const uint64_t *reader, const uint64_t *copy, int in_order)
{
    uint64_t number = reader[PASSED] - 1;
    if (found == NOTHING && memcmp(from->reader, reader, 16))
        fail("nothing, and yet it went on", found, from, reader);
    if (found == GAP) {
        if (reader[PASSED] - from->reader[PASSED] != reader[LOST])
            fail("a wrong count", found, from, reader);
        for (uint64_t lost = from->reader[PASSED]; lost < reader[PASSED] && lost < (uint64_t)records; lost++)
            if ((int)lost != nameless && values[INTENT][length < 0 ? newest[INTENT] : view.seen[INTENT]] <= start[lost] + capacity)
                fail("lost without need", found, from, reader);
    }
    if (found < 0)
        return;
    if (number >= (uint64_t)records || reader[POSITION] != start[number + 1] || (uint64_t)found != size[number] ||
        (in_order && number != from->reader[PASSED])) {
        fail("another record", found, from, reader);
        return;
    }
    for (uint64_t i = 0; i < size[number] / 8; i++)
        if (copy[ENTRY_HEADER + i] != payload_of(number, i))
            fail("not as it was appended", found, from, reader);
}

static void keep(const State *state)
{
    uint32_t hash = crc32(0, (const uint8_t *)state, sizeof *state) & 0xfffff;
    for (; hashed[hash]; hash = (hash + 1) & 0xfffff)
        if (!memcmp(&states[hashed[hash] - 1], state, sizeof *state))
            return;
    if (state_count == MOST_STATES)
        exit(3);
    states[state_count++] = *state;
    hashed[hash] = state_count;
}

typedef int64_t Call(Word *, uint64_t, uint64_t, uint64_t *, uint64_t *);

static void explore(Call *call, int in_order)
{
    uint64_t copy[MOST_WORDS];
    State next = {0};
    memset(hashed, 0, sizeof hashed);
    state_count = 0;
    keep(&next);
    for (int at = 0; at < state_count && !wrong; at++) {
        State from = states[at];
        length = 0;
        do {
            next = from;
            view = from.view;
            memset(&pending, 0, sizeof pending);
            depth = 0;
            int64_t found = call(memory, capacity, longest, next.reader, copy);
            executions++;
            check(found, &from, next.reader, copy, in_order);
            next.reader[KIND] = next.reader[LOST] = 0;
            next.view = view;
            keep(&next);
            while (length && choice[length - 1] + 1 >= limit[length - 1])
                length--;
            if (length)
                choice[length - 1]++;
        } while (length && !wrong);
        length = -1; /* at last all is seen */
        next = from;
        for (int calls = 0; calls < 2 * records + 2; calls++) {
            State before = next;
            check(call(memory, capacity, longest, next.reader, copy), &before, next.reader, copy, in_order);
        }
        int raises_head = published && values[LATEST][newest[LATEST]] == values[HEAD][newest[HEAD]]; /* it died there */
        int is_gone = !in_order && published && values[INTENT][newest[INTENT]] > start[published - 1] + capacity;
        if (next.reader[PASSED] != published && !raises_head && !is_gone)
            fail("not all were delivered or declared", NOTHING, &from, next.reader);
    }
}

static void append(int from, int is_second)
{
    uint64_t payload[MOST_WORDS];
    for (int number = from; number < records && stores < last_store; number++) {
        size[number] = is_second ? 0 : size[number];
        start[number + 1] = start[number] + entry_size(size[number]);
        for (uint64_t i = 0; i < size[number] / 8; i++)
            payload[i] = payload_of((uint64_t)number, i);
        dxl_append(memory, capacity, longest, 1, (const uint8_t *)payload, size[number]);
    }
}

/* One writer that dies at a store, or none; then another one, or none. Returns how many states were explored. */
static long run(int dies_at, int goes_on)
{
    long states_in_all = 0;
    memset(newest, 0, sizeof newest);
    memset(values, 0, sizeof values);
    memset(shown, 0, sizeof shown);
    memset(&writer, 0, sizeof writer);
    memset(&fenced, 0, sizeof fenced);
    stores = 0;
    nameless = -1;
    last_store = died = dies_at;
    writing = 1;
    append(0, 0);
    for (published = 0; start[published] < values[HEAD][newest[HEAD]];)
        published++;
    if (goes_on) {
        last_store = 1 << 30;
        memset(&fenced, 0, sizeof fenced); /* it has seen all that the first one stored */
        if (values[NUMBER][newest[NUMBER]] > published) {
            nameless = (int)published++;
            start[published] = start[nameless];
        }
        append((int)published, 1);
        published = (uint64_t)records;
    }
    writing = 0;
    if (values[HEAD][newest[HEAD]] != start[published])
        wrong++, printf("the head is not behind the last record\n");
    explore(dxl_read_next, 1);
    states_in_all += state_count;
    explore(dxl_read_newest, 0);
    return states_in_all + state_count;
}

/* ring_model WRITERS CAPACITY WORDS...: how many writers there are, one after the other died; a ring of so many words,
 * and how many words each record's payload has. */
int main(int count, char **given)
{
    long states_in_all = 0;
    int writers = atoi(given[1]);
    capacity = 8 * strtoull(given[2], NULL, 10);
    records = count - 3;
    int all_stores = 1 << 30;
    for (int dies_at = 1 << 30; dies_at >= 0 && !wrong; dies_at = (dies_at > all_stores ? all_stores : dies_at) - 1) {
        for (int goes_on = 0; goes_on < writers && !wrong; goes_on++) {
            for (int i = 0; i < records; i++) {
                size[i] = 8 * strtoull(given[3 + i], NULL, 10);
                longest = size[i] > longest ? size[i] : longest;
            }
            states_in_all += run(dies_at, goes_on);
            all_stores = dies_at == 1 << 30 ? stores : all_stores;
        }
    }
    printf("%ld states, %ld executions, %ld loads, %d stores\n", states_in_all, executions, loads, all_stores);
    return wrong != 0;
}
