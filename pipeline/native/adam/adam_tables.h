// The arguments of an Adam step in the form that the CPU kernels need. Not for kernel files.
#pragma once

#include "adam/adam.h"
#include "adam/adam_step.h"

namespace splat {

// The job and the tables that it points to, which live as long as this object.
class AdamTables {
  public:
    // At most kAdamTensors tensors.
    AdamTables(const std::vector<AdamRows>& tensors, std::int64_t rows, const std::uint8_t* visible,
               const AdamOptions& options);
    AdamTables(const AdamTables&) = delete;
    AdamTables& operator=(const AdamTables&) = delete;

    const AdamJob& job() const { return job_; }

  private:
    AdamJob job_{};
    std::vector<std::vector<float>> rates_;
    std::vector<std::vector<std::int32_t>> row_of_;
};

}  // namespace splat
