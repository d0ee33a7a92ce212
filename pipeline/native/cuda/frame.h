// A frame on the device: the data shared by its kernels, and its layout in the caller's memory.
//
// The order of work is that of the CPU (raster_cpu.cpp): project every Gaussian; stably sort the visible ones by depth;
// build each tile's list by a stable sort of the depth-ordered pairs by tile; blend; and the backward pass. Pairs are
// processed in chunks of consecutive tiles, each of at most `capacity` pairs: the first `passes` chunks by launches of
// their own, and any beyond the forecast by one more launch, whose blocks wait for each other between phases, so that
// the host never waits for a count. A phase is a device function over virtual blocks, which a kernel of any number of
// blocks, even one, can run:
//
//     for (int64_t block = blockIdx.x; block < blocks; block += gridDim.x) ...
//
// Each Gaussian's gradients are summed from its slots in order of its tiles, whatever the chunks: bit-identical for
// every capacity and number of passes, without atomic operations on floats.
#pragma once

#include "base/device.h"
#include "cuda/api.h"
#include "raster/raster.h"

namespace splat {
namespace cuda {

// A splat as stored; the other fields of raster.h's Splat are derived from it (see expand in project.cuh).
struct alignas(16) Record {
    float x, y, a, b;
    float c, log2_opacity, red, green;
    float blue, depth, depth_u, depth_v;
};
static_assert(sizeof(Record) == 48, "three vectors of four");

constexpr int kSortItems = 8;  // keys per thread in a pass of the radix sort: 100,000 keys occupy 49 blocks
constexpr int kSortBlock = kThreads * kSortItems;  // keys per virtual block
constexpr int kDigitBits = 8, kDigits = 1 << kDigitBits;
constexpr int64_t kChunkTiles = 1 << 16;  // maximum tiles per chunk: keys of pairs are 16 bits
constexpr int kScanBlock = kThreads;      // ranks per virtual block in counting pairs

// In device memory; starts with SplatFrameFacts, which the host may read.
struct Header {
    SplatFrameFacts facts;
    int64_t chunk_pairs;  // of the current chunk
    int32_t visible;      // facts.visible, for the sort
    int32_t sorted;       // chunk_pairs, for the sort
};

// Pointers into the frame's memory. n Gaussians, t tiles, c pairs of capacity.
struct FrameMemory {
    Header* header;
    Record* records;         // (n), meaningful where visible
    uint32_t* rows;          // (n): first tile row << 16 | number of tile rows; 0 rows if not visible
    uint32_t* keys[2];       // (n): bits of the depth or kCulled, double-buffered for the sort; in the memory of pairs
    int32_t* order[2];       // (n): Gaussian by rank, near to far, in order[0] once sorted; [1] lies like keys
    uint32_t* offsets;       // (n) by rank: the first pair in the chunk
    uint32_t* block_sums;    // (ceil(n / kScanBlock) + 1)
    uint32_t* digit_table;   // (kDigits, sort blocks of max(n, c)), digits first
    uint32_t* digit_sums;    // (kDigits)
    int32_t* tile_counts;    // (t + 1): differences, +1 at a span's first tile and -1 after its last; then pairs
    int64_t* tile_begin;     // (t + 1): pairs of the view before the tile
    int32_t* chunk_begin;    // (t + 1): first tile of each chunk, and t at the end
    float* transmittance;    // (t, 256): behind everything; a tile's pixels in thread order, see blend.cuh
    int32_t* pixel_end;      // (t, 256): number of the tile's pairs that the pixel processed before it ended
    uint16_t* pair_keys[2];  // (c): tile minus the chunk's first tile
    uint32_t* pair_values[2];  // (c): a pair's index before the sort, which is its slot; sorted in [0]
    uint32_t* owners;          // (c): the Gaussian of each slot
};

// Pointers into the memory of the backward pass.
struct BackMemory {
    float* slots;  // (c, slot_floats) of the current chunk
    float* sums;   // (n, slot_floats): SplatGradient's fields in order, by Gaussian; zero if not visible
};

// Everything that a kernel of the frame gets, by value.
struct Job {
    View view;
    Parameters model;
    FrameMemory at;
    BackMemory back;
    int64_t capacity;
    int tiles;
    int slot_floats;  // kDepthSlotFloats if the shot has depths, else kSlotFloats
    int magnitudes;
    Pictures pictures;
    PictureGradients gradients;
    float* radii;
    uint8_t* visible;
};

// Allocates pieces of memory, each aligned to 256 bytes; with a null base it only counts.
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

// Validates the caller's arguments and fills a job's view, sizes and frame memory. Returns a code of api.h. In
// frame.cu.
int32_t prepare(const SplatShot* shot, const SplatFrame* frame, Job* job);

// The same of a render of raw parameters: validates and fills all of a job, except images, their gradients, radii and
// visible. `back`: whether the backward pass's memory is needed. Returns a code of api.h. In frame.cu.
int32_t prepare(const SplatShot* shot, const SplatRows* model, const SplatFrame* frame, bool back, Job* job);

// Number of blocks for `work` virtual ones that can take turns: enough to fill the device, at least one. In frame.cu.
int64_t blocks_for(int64_t work);

// The launches of a frame's lists, all in frame.cu. First, memory that counts from zero; then the kernel that fills
// records, rows and keys and counts the tiles' pairs; then the sort by depth and the plan; then each chunk's lists.
void clear_counts(const Job& job, cudaStream_t stream);
void launch_plan(const Job& job, cudaStream_t stream);

// The kernels of a chunk do nothing if it does not exist, and its binning kernels do nothing in the backward pass if
// the lists of the forward pass are still there, i.e. if there was one chunk.
struct Turn {
    int chunk;
    bool back;
};

void launch_bin(const Job& job, const Turn& turn, cudaStream_t stream);

// Chunks with launches of their own. A chunk has kChunkTiles tiles at most: as many rounds as that takes are always
// foreseen.
int passes_of(const Job& job, const SplatFrame& frame);

// One block per tile, as many as a chunk can have.
int64_t tile_blocks(const Job& job);

}  // namespace cuda
}  // namespace splat
