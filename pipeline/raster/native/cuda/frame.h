// A frame on the device: what its kernels share, and where it lies in the caller's memory.
//
// The order of work is the CPU's (raster_cpu.cpp): project every Gaussian; sort the visible ones by depth, stably; give
// each tile its list by a stable sort of the pairs, in order of depth, by tile; blend; and back. Pairs are worked off
// in chunks of consecutive tiles, none of more than `capacity` pairs: the first `passes` of them by the whole device,
// and what a view has more than was foreseen by one block in one more launch. So the host never waits for a count. A
// phase of the work is a device function over virtual blocks, which a kernel of any number of blocks, one too, can run:
//
//     for (int64_t block = blockIdx.x; block < blocks; block += gridDim.x) ...
//
// Each Gaussian's gradients are summed from its slots in the order of its tiles, whatever the chunks: the same bits for
// every capacity and number of passes, with no atomic operation on a float.
#pragma once

#include "../raster.h"
#include "api.h"
#include "device.h"

namespace splat {
namespace cuda {

// A splat as it is kept; what else raster.h's Splat has follows from it (see expand in project.cuh).
struct alignas(16) Record {
    float x, y, a, b;
    float c, log2_opacity, red, green;
    float blue, depth, depth_u, depth_v;
};
static_assert(sizeof(Record) == 48, "three vectors of four");

constexpr int kSortItems = 8;  // a thread's keys in a pass of the radix sort: 100,000 keys are work for 49 blocks
constexpr int kSortBlock = kThreads * kSortItems;  // a virtual block's
constexpr int kDigitBits = 8, kDigits = 1 << kDigitBits;
constexpr int64_t kChunkTiles = 1 << 16;  // a chunk has no more tiles: keys of pairs are 16 bits
constexpr int kScanBlock = kThreads;      // ranks a virtual block counts pairs of

// Device memory; starts with SplatFrameFacts, which the host may read.
struct Header {
    SplatFrameFacts facts;
    int64_t chunk_pairs;  // of the chunk that is worked on
    int32_t visible;      // facts.visible, as the sort reads it
    int32_t sorted;       // chunk_pairs, as the sort reads it
};

// Pointers into the frame's memory. n Gaussians, t tiles, c pairs of capacity.
struct FrameMemory {
    Header* header;
    Record* records;           // (n), meaningful where visible
    uint32_t* rows;            // (n): first tile row << 16 | number of tile rows; 0 rows where not visible
    uint32_t* keys[2];         // (n): bits of the depth or kCulled, two for the sort; in the memory of pairs
    int32_t* order[2];         // (n): ranks to Gaussians, from near to far, in order[0] once sorted; [1] as keys
    uint32_t* offsets;         // (n) by rank: the first pair in the chunk
    uint32_t* block_sums;      // (ceil(n / kScanBlock) + 1)
    uint32_t* digit_table;     // (kDigits, sort blocks of max(n, c)), digits first
    uint32_t* digit_sums;      // (kDigits)
    int32_t* tile_counts;      // (t + 1): differences, +1 at a span's first tile and -1 behind its last; then pairs
    int64_t* tile_begin;       // (t + 1): pairs of the view before the tile
    int32_t* chunk_begin;      // (t + 1): first tile of each chunk, and t at the end
    float* transmittance;      // (t, 256): behind everything; a tile's pixels by threads, see blend.cuh
    int32_t* pixel_end;        // (t, 256): how many of the tile's pairs the pixel looked at before it ended
    uint16_t* pair_keys[2];    // (c): tile less the chunk's first
    uint32_t* pair_values[2];  // (c): a pair's place before the sort, which is its slot; sorted in [0]
    uint32_t* owners;          // (c): by slot, the Gaussian
};

// Pointers into the memory of the backward pass.
struct BackMemory {
    float* slots;  // (c, slot_floats) of the chunk that is worked on
    float* sums;   // (n, slot_floats): SplatGradient's fields in their order, by Gaussian; zero where not visible
};

// All that a kernel of the frame gets, by value.
struct Job {
    View view;
    Parameters model;
    FrameMemory at;
    BackMemory back;
    int64_t capacity;
    int tiles;
    int slot_floats;  // kDepthSlotFloats where the shot has depths, else kSlotFloats
    int magnitudes;
    Pictures pictures;
    PictureGradients gradients;
    float* radii;
    uint8_t* visible;
};

// Hands out pieces of memory, each aligned to 256 bytes; from null it only counts.
class Carver {
  public:
    explicit Carver(void* memory) : begin_(static_cast<char*>(memory)) {}
    template <class T>
    T* take(int64_t count) {
        char* piece = begin_ + bytes_;
        bytes_ += (count * static_cast<int64_t>(sizeof(T)) + 255) / 256 * 256;
        return reinterpret_cast<T*>(piece);
    }
    int64_t bytes() const { return bytes_; }

  private:
    char* begin_;
    int64_t bytes_ = 0;
};

// The layouts; they return their sizes. In frame.cu.
int64_t lay_out(void* memory, int64_t count, int64_t tiles, int64_t capacity, FrameMemory* at);
int64_t lay_out(void* memory, int64_t count, int64_t capacity, int slot_floats, BackMemory* at);

// Checks what the caller brought and makes a job of it: all but pictures, their gradients, radii and visible. `back`:
// whether the backward pass's memory is wanted. Returns a code of api.h. In frame.cu.
int32_t prepare(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame, bool back, Job* job);

// Blocks for `work` virtual ones that may as well take turns: enough to fill the device, at least one. In frame.cu.
int64_t blocks_for(int64_t work);

}  // namespace cuda
}  // namespace splat
