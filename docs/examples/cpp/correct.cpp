// Corrects states with a model of `measure train`, by onnxruntime's C API.
//
//   correct MODEL.onnx PERIOD_S < states > corrections
//
// A line of input is a stamp in s and the state's numbers; a line of output is the error in mm
// (x y z), the nine numbers of its covariance in mm^2, and 1 if the state is unlike the training.

#include <onnxruntime_c_api.h>

#include <array>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <limits>
#include <sstream>
#include <string>
#include <utility>
#include <vector>

namespace {

const OrtApi* const api = OrtGetApiBase()->GetApi(ORT_API_VERSION);

void check(OrtStatus* status) {
  if (status == nullptr) return;
  std::fprintf(stderr, "correct: %s\n", api->GetErrorMessage(status));
  std::exit(2);
}

// A row of float32 numbers that onnxruntime reads or writes in place.
struct Row {
  explicit Row(std::int64_t width) : numbers(static_cast<std::size_t>(width), 0.0F) {
    const std::array<std::int64_t, 2> shape{1, width};
    OrtMemoryInfo* memory = nullptr;
    check(api->CreateCpuMemoryInfo(OrtArenaAllocator, OrtMemTypeDefault, &memory));
    check(api->CreateTensorWithDataAsOrtValue(memory, numbers.data(),
                                              numbers.size() * sizeof(float), shape.data(), 2,
                                              ONNX_TENSOR_ELEMENT_DATA_TYPE_FLOAT, &value));
    api->ReleaseMemoryInfo(memory);
  }
  Row(const Row&) = delete;
  Row& operator=(const Row&) = delete;
  ~Row() { api->ReleaseValue(value); }

  std::vector<float> numbers;
  OrtValue* value = nullptr;
};

OrtSession* load(const char* path) {
  OrtEnv* env = nullptr;
  OrtSessionOptions* options = nullptr;
  OrtSession* session = nullptr;
  check(api->CreateEnv(ORT_LOGGING_LEVEL_ERROR, "correct", &env));
  check(api->CreateSessionOptions(&options));
  check(api->SetIntraOpNumThreads(options, 1));  // more threads make the slowest answers slower
  check(api->SetInterOpNumThreads(options, 1));
  check(api->CreateSession(env, path, options, &session));
  api->ReleaseSessionOptions(options);
  return session;  // this and the environment live as long as the program
}

std::int64_t width(const OrtSession* session, std::size_t input) {
  OrtTypeInfo* type = nullptr;
  const OrtTensorTypeAndShapeInfo* tensor = nullptr;
  std::array<std::int64_t, 2> shape{};
  check(api->SessionGetInputTypeInfo(session, input, &type));
  check(api->CastTypeInfoToTensorInfo(type, &tensor));
  check(api->GetDimensions(tensor, shape.data(), shape.size()));
  api->ReleaseTypeInfo(type);
  return shape[1];
}

// One robot's running trajectory. Nothing is allocated after the first update.
class Corrector {
 public:
  Corrector(const char* path, double period_s)
      : session_(load(path)),
        period_s_(period_s),
        state(width(session_, 0)),
        before_(width(session_, 1)),
        after_(width(session_, 1)) {}

  void update(double time_s) {
    const bool due = !(time_s - ticked_s_ < 0.75 * period_s_);
    if (due) ticked_s_ = time_s;
    tick_.numbers[0] = due ? 1.0F : 0.0F;
    const char* const inputs[] = {"features", "memory", "tick"};
    const char* const outputs[] = {"error_mm", "covariance", "strangeness", "memory_out"};
    const OrtValue* const given[] = {state.value, memory_->value, tick_.value};
    OrtValue* made[] = {error_mm.value, covariance.value, strangeness.value, next_->value};
    check(api->Run(session_, nullptr, inputs, given, 3, outputs, 4, made));
    std::swap(memory_, next_);
  }

 private:
  OrtSession* session_;
  double period_s_;
  double ticked_s_ = -std::numeric_limits<double>::infinity();

 public:
  Row state, error_mm{3}, covariance{9}, strangeness{1};

 private:
  Row before_, after_, tick_{1};
  Row* memory_ = &before_;
  Row* next_ = &after_;
};

}  // namespace

int main(int count, char** words) {
  if (count != 3) {
    std::fprintf(stderr, "usage: correct MODEL.onnx PERIOD_S < states\n");
    return 2;
  }
  Corrector corrector(words[1], std::atof(words[2]));
  std::string line;
  while (std::getline(std::cin, line)) {
    std::istringstream row(line);
    double time_s = 0.0;
    row >> time_s;
    for (float& number : corrector.state.numbers) row >> number;
    if (!row) {
      std::fprintf(stderr, "correct: a line has fewer than 1 + %zu numbers\n",
                   corrector.state.numbers.size());
      return 2;
    }
    corrector.update(time_s);
    for (const float number : corrector.error_mm.numbers) std::printf("%.9g ", number);
    for (const float number : corrector.covariance.numbers) std::printf("%.9g ", number);
    std::printf("%d\n", !(corrector.strangeness.numbers[0] <= 1.0F));
  }
  return 0;
}
