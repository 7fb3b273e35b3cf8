# palpate_add_tests(PREFIX LIBRARY INCLUDE HEADERS...): one executable per *_test.cpp here, linked with LIBRARY and the counting
# allocators, and each public header (below the folder INCLUDE) compiled on its own.
find_package(GTest QUIET)
if(NOT GTest_FOUND)
  message(FATAL_ERROR "GoogleTest not found. On Debian or Ubuntu: apt-get install libgtest-dev "
                      "(scripts/install-debian.sh does it). Without the C++ tests: -DPALPATE_BUILD_TESTS=OFF")
endif()
include(GoogleTest)

function(palpate_add_tests prefix library include)
  file(GLOB tests CONFIGURE_DEPENDS ${CMAKE_CURRENT_SOURCE_DIR}/*_test.cpp)
  foreach(source IN LISTS tests)
    get_filename_component(topic ${source} NAME_WE)
    set(test ${prefix}_${topic})
    add_executable(${test} ${source})
    target_link_libraries(${test} PRIVATE ${library} palpate_test_support palpate_warnings GTest::gtest_main)
    target_compile_definitions(${test} PRIVATE _GLIBCXX_ASSERTIONS)
    target_compile_options(${test} PRIVATE -Wno-dangling-else)  # EXPECT_* holds an if; it stands after ifs all the time
    list(APPEND targets ${test})
    gtest_discover_tests(${test} TEST_PREFIX "${topic}." PROPERTIES TIMEOUT 300 DISCOVERY_TIMEOUT 60)
  endforeach()

  add_custom_target(${prefix}_tests DEPENDS ${targets})

  # A header that leans on what its includer happened to include breaks the first user with another order.
  foreach(header IN LISTS ARGN)
    file(RELATIVE_PATH name ${include} ${header})
    string(MAKE_C_IDENTIFIER ${name} identifier)
    set(source ${CMAKE_CURRENT_BINARY_DIR}/headers/${identifier}.cpp)
    file(CONFIGURE OUTPUT ${source} CONTENT "#include \"${name}\"\n#include \"${name}\"  // and once more: the guard\n" @ONLY)
    list(APPEND header_sources ${source})
  endforeach()
  add_library(palpate_${prefix}_headers_alone OBJECT ${header_sources})
  target_link_libraries(palpate_${prefix}_headers_alone PRIVATE ${library} palpate_warnings)
  target_compile_options(palpate_${prefix}_headers_alone PRIVATE -O0)
endfunction()
