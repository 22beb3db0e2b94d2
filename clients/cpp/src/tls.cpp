#include <nesam/tls.hpp>

#include <fstream>
#include <iterator>

namespace nesam {

Result<Tls> Tls::from_files(const std::string& authority, const std::string& certificate, const std::string& key) {
  Tls tls;
  const struct {
    const std::string& path;
    std::string& text;
    const char* field;
  } parts[] = {{authority, tls.authority, "authority"}, {certificate, tls.certificate, "certificate"}, {key, tls.key, "key"}};
  for (const auto& part : parts) {
    if (part.path.empty()) continue;
    std::ifstream file(part.path, std::ios::binary);
    part.text.assign(std::istreambuf_iterator<char>(file), {});
    if (!file || part.text.empty()) return Error(Code::not_found, part.field, part.path + " cannot be read or is empty");
  }
  return tls;
}

}  // namespace nesam
