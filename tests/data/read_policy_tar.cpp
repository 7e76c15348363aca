// Loads a policy.tar by rl_tools' own loader into the type that PX4's mc_raptor is compiled for, and runs the file's example
// as mc_raptor does: batch by batch, step by step. Prints each output, then the mean difference to the example's.
// Header names and the order of the includes: rl_tools 2.2.1; the type: PX4-Autopilot, src/modules/mc_raptor/blob/policy.h.
#include <rl_tools/operations/cpu.h>

#include <rl_tools/nn/layers/dense/operations_cpu.h>
#include <rl_tools/nn/layers/gru/operations_generic.h>
#include <rl_tools/nn_models/sequential/operations_generic.h>

#include <rl_tools/persist/backends/tar/operations_cpu.h>
#include <rl_tools/persist/backends/tar/operations_generic.h>
#include <rl_tools/nn/parameters/persist.h>
#include <rl_tools/nn/layers/dense/persist.h>
#include <rl_tools/nn/layers/gru/persist.h>
#include <rl_tools/nn_models/sequential/persist.h>

#include <cmath>
#include <cstdio>
#include <fstream>
#include <iterator>
#include <vector>

namespace rlt = rl_tools;
using Device = rlt::devices::DefaultCPU;
using Index = Device::index_t;
using Types = rlt::numeric_types::Policy<float>;
using Activation = rlt::nn::activation_functions::ActivationFunction;
constexpr Index STEPS = 500, BATCH = 2, INPUTS = 22, UNITS = 16, MOTORS = 4;

using First = rlt::nn::layers::dense::BindConfiguration<rlt::nn::layers::dense::Configuration<Types, Index, UNITS, Activation::RELU>>;
using Gru = rlt::nn::layers::gru::BindConfiguration<rlt::nn::layers::gru::Configuration<Types, Index, UNITS>>;
using Last = rlt::nn::layers::dense::BindConfiguration<rlt::nn::layers::dense::Configuration<Types, Index, MOTORS, Activation::IDENTITY>>;
template <typename Content, typename Next = rlt::nn_models::sequential::OutputModule>
using Module = rlt::nn_models::sequential::Module<Content, Next>;
using Chain = Module<First, Module<Gru, Module<Last>>>;
using Policy = rlt::nn_models::sequential::Build<rlt::nn::capability::Forward<true>, Chain, rlt::tensor::Shape<Index, STEPS, 1, INPUTS>>;

int main(int, char **arguments)
{
    std::ifstream file(arguments[1], std::ios::binary);
    std::vector<char> content((std::istreambuf_iterator<char>(file)), std::istreambuf_iterator<char>());
    const Index steps = std::stoul(arguments[2]);

    Device device;
    rlt::init(device);
    Device::SPEC::RANDOM::ENGINE<> rng;
    rlt::malloc(device, rng);
    rlt::init(device, rng, 0);
    Policy policy;
    Policy::State<true> state;
    Policy::Buffer<true> buffer;
    rlt::malloc(device, policy);
    rlt::malloc(device, state);
    rlt::malloc(device, buffer);
    rlt::Tensor<rlt::tensor::Specification<float, Index, rlt::tensor::Shape<Index, 1, INPUTS>>> input;
    rlt::Tensor<rlt::tensor::Specification<float, Index, rlt::tensor::Shape<Index, 1, MOTORS>>> output;
    rlt::malloc(device, input);
    rlt::malloc(device, output);

    rlt::persist::backends::tar::ReaderGroup<rlt::persist::backends::tar::ReaderGroupSpecification<Index>> reader;
    reader.data = content.data();
    reader.size = content.size();
    auto actor = rlt::get_group(device, reader, "actor");
    char name[256] = {};
    rlt::get_attribute<char *>(device, actor, "checkpoint_name", name, sizeof name);
    rlt::load(device, policy, actor);

    char *inputs = nullptr, *outputs = nullptr;
    Index input_size = 0, output_size = 0;
    if (!rlt::persist::backends::tar::get(device, reader.data, reader.size, "example/input/data", inputs, input_size)
        || !rlt::persist::backends::tar::get(device, reader.data, reader.size, "example/output/data", outputs, output_size)
        || input_size < steps * BATCH * INPUTS * sizeof(float) || output_size < steps * BATCH * MOTORS * sizeof(float)) {
        return 2;
    }
    const float *given = reinterpret_cast<const float *>(inputs), *wanted = reinterpret_cast<const float *>(outputs);
    rlt::Mode<rlt::mode::Evaluation<>> mode;
    double sum = 0.0;
    for (Index row = 0; row < BATCH; ++row) {
        rlt::reset(device, policy, state, rng);
        for (Index step = 0; step < steps; ++step) {
            for (Index k = 0; k < INPUTS; ++k) {
                rlt::set(device, input, given[(step * BATCH + row) * INPUTS + k], 0, k);
            }
            rlt::evaluate_step(device, policy, input, state, output, buffer, rng, mode);
            for (Index k = 0; k < MOTORS; ++k) {
                const float value = rlt::get(device, output, 0, k);
                sum += std::fabs(value - wanted[(step * BATCH + row) * MOTORS + k]);
                std::printf("%.9g\n", static_cast<double>(value));
            }
        }
    }
    std::printf("%.9g\n%s\n", sum / static_cast<double>(steps * BATCH * MOTORS), name);
    return 0;
}
