# Makes a test of the C++ blocks of pages: awk -f blocks.awk README.md ... > blocks_test.cpp
#
# The blocks of a page are one function, each in a scope within that of the block before it, as a reader types them one after the other. Includes go to the top, the
# address of the text becomes that of the test's server, and deadlines that a busy machine may miss, 50 ms and that of the client, a minute. The compiler names page
# and line.
# A remark above a block as in the book: `before` has C++ that comes first, `compiled only: WHY` says why nothing can run it.

FNR == 1 { end_page() }

in_block && /^```/ {
  if (only) body = body "}; (void)compiled;\n"
  in_block = only = 0
  next
}
in_block {
  gsub(/\("127\.0\.0\.1:50051"\)/, "(address, patient)")
  gsub(/"127\.0\.0\.1:50051"/, "address")
  gsub(/std::chrono::milliseconds\(50\)/, "std::chrono::minutes(1)")
  if (/^#include/) {
    if (!($0 in included)) includes = includes $0 "\n"
    included[$0] = 1
    $0 = ""
  }
  body = body $0 "\n"
  next
}
in_other { in_other = !/^```/; next }
in_before && /^-->/ { in_before = 0; next }
in_before { before = before $0 "\n"; next }

/^<!-- before$/ { in_before = 1; before = "#line " FNR + 1 " \"" FILENAME "\"\n"; next }
/^<!-- compiled only: .+ -->$/ { only = 1; next }
/^```(cpp|c\+\+|C\+\+|cc)$/ {
  blocks++
  if (!depth++) {
    body = body "void page_" ++pages "(const std::string& address) {\nnesam::ClientOptions patient;\npatient.timeout = std::chrono::minutes(1);\n"
    calls = calls "    run(\"service_blocks_of_" FILENAME "\", [&] { page_" pages "(argv[1]); });\n"
  }
  body = body "{\ncurrent = \"" FILENAME ":" FNR "\";\n" (only ? "auto compiled = [&] {\n" : "") before "#line " FNR + 1 " \"" FILENAME "\"\n"
  in_block = 1
  before = ""
  next
}
/^```/ { in_other = 1 }
# A remark belongs to what follows it.
/./ { before = ""; only = 0 }

function end_page() {
  if (in_block || in_other || in_before) cut = 1
  if (depth) body = body "}\n"
  for (; depth > 0; depth--) body = body "}\n"
  in_block = in_other = in_before = only = 0
  before = ""
}

END {
  end_page()
  if (cut || !blocks) {
    print "blocks.awk: a block or remark does not end, or there is none" > "/dev/stderr"
    exit 1
  }
  print includes "#include \"check.hpp\"\n\nnamespace {\n"
  print body "\n}  // namespace\n\n#line 1 \"blocks_test.cpp\""
  print "int main(int argc, char** argv) {\n  return run_against_server(argc, argv, [&](nesam::Client&) {\n" calls "  });\n}"
}
